"""Shared fixtures of the examples' tests."""

from __future__ import annotations

import functools
import os
from collections.abc import Callable
from dataclasses import replace

os.environ.setdefault("OMP_NUM_THREADS", "1")  # as in the examples: one process, one core

import pytest

from rosrm_examples.arrays import Points
from rosrm_examples.drives import Drive, load_drive
from rosrm_examples.errors import DriveError


@pytest.fixture(scope="session")
def kitti0001() -> Drive:
    """Return KITTI's drive 0001, where this machine has it."""
    try:
        return load_drive("kitti0001")
    except DriveError as error:
        pytest.skip(f"KITTI is not here: {error}")


@pytest.fixture(scope="session")
def street() -> Callable[[int], Drive]:
    """Return a function that loads the simulated street with a number of scans.

    Each scan is made once and read-only.
    """

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
