"""What the tests of the examples share."""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")  # as the examples run: one process, one core

import pytest

from rosrm_examples.drives import Drive, load_drive
from rosrm_examples.errors import DriveError


@pytest.fixture(scope="session")
def kitti0001() -> Drive:
    """KITTI's drive 0001, where this machine has it."""
    try:
        return load_drive("kitti0001")
    except DriveError as error:
        pytest.skip(f"KITTI is not here: {error}")
