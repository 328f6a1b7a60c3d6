"""Fixtures that several tests of CRIU's engine share."""

from __future__ import annotations

import pytest


@pytest.fixture
def work(tmp_path):
    """Return an empty working directory."""
    (tmp_path / "work").mkdir()
    return tmp_path / "work"
