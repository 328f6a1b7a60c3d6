"""What all tests share: each is marked with the folder that it lies in."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from hypothesis import settings

from tests.criu_kit import criu, theatre  # noqa: F401 - fixtures of several layers

HERE = Path(__file__).parent

# By default DDS multicasts on every interface: what a test starts stays on this machine.
os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")

# Where `make setup` has put CRIU, if it could be had.
os.environ.setdefault("ROSRM_CRIU_PREFIX", str(HERE.parent / ".venv/criu"))

# A busy machine may take its time for one example.
settings.register_profile("rosrm", deadline=None)
settings.load_profile("rosrm")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    for item in items:
        layer = item.path.relative_to(HERE).parts[0]
        item.add_marker(getattr(pytest.mark, layer))
