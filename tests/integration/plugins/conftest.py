"""A fresh virtual environment for each test."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.pip_environments import Environment, pip_environment


@pytest.fixture
def environment(tmp_path: Path) -> Environment:
    return pip_environment(tmp_path)
