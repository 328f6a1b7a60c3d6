"""What the tests of the examples share."""

from __future__ import annotations

import functools
import os
from collections.abc import Callable
from dataclasses import replace

os.environ.setdefault("OMP_NUM_THREADS", "1")  # as the examples run: one process, one core

import pytest

from rosrm_examples.arrays import Points
from rosrm_examples.drives import Drive, load_drive
from rosrm_examples.errors import DriveError


@pytest.fixture(scope="session")
def kitti0001() -> Drive:
    """KITTI's drive 0001, where this machine has it."""
    try:
        return load_drive("kitti0001")
    except DriveError as error:
        pytest.skip(f"KITTI is not here: {error}")


@pytest.fixture(scope="session")
def street() -> Callable[[int], Drive]:
    """The simulated street of so many scans; each of them is made once, and nobody changes it."""

    @functools.cache
    def load(scans: int) -> Drive:
        drive = load_drive(f"street:{scans}")

        @functools.cache
        def read(index: int) -> Points:
            points = drive.read(index)
            points.flags.writeable = False
            return points

        return replace(drive, read=read)

    return load
