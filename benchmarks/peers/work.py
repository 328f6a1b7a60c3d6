"""The work of the comparison, for every environment: the standard library alone.

Ray and Dask run these functions in workers of their own; each starts a process and waits for it.
"""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

#: Prints unix time in nanoseconds as its first action.
STAMP = ("date", "+%s%N")
#: Fills MB of memory, makes a file, and holds the memory until another file exists.
HOLDER = """
import pathlib, sys, time
held = b"x" * (int(sys.argv[1]) * 10**6)
pathlib.Path(sys.argv[2]).touch()
end = pathlib.Path(sys.argv[3])
while not end.exists():
    time.sleep(0.05)
"""


def stamp(_: object = None) -> int:
    """Return the unix time, nanoseconds, that a new process read."""
    return int(_ended(STAMP))


def succeed(_: object = None) -> None:
    """Run `true`."""
    _ended(("true",))


def sleep(seconds: float) -> None:
    """Run `sleep`."""
    _ended(("sleep", str(seconds)))


def hold(arguments: tuple[int, str, str]) -> None:
    """Run a process that holds memory."""
    _ended(holder(*arguments))


def holder(megabytes: int, filled: str, end: str) -> list[str]:
    """Return the command of a process that holds memory.

    Args:
        megabytes: to hold.
        filled: path of a file that it makes when the memory is filled.
        end: path of a file at whose presence it ends.
    """
    return [sys.executable, "-S", "-c", HOLDER, str(megabytes), filled, end]


def wait_for_files(paths: Sequence[Path], timeout: float) -> int:
    """Wait until all files exist; return the unix time of the newest, nanoseconds."""
    deadline = time.monotonic() + timeout
    while missing := [one for one in paths if not one.exists()]:
        if time.monotonic() >= deadline:
            raise TimeoutError(f"{len(missing)} of {len(paths)} processes did not start in time")
        time.sleep(0.02)
    return max(one.stat().st_mtime_ns for one in paths)


def _ended(command: Sequence[str]) -> bytes:
    return subprocess.run(command, check=True, stdin=subprocess.DEVNULL, capture_output=True).stdout
