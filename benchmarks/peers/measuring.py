"""Measurements of the comparison, for any executor of functions; needs only the standard library.

A runner is a program of an environment of its own. Its arguments name one measurement, and the last
line of its output is the JSON of the result.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from functools import partial
from pathlib import Path
from typing import Any, Protocol

from benchmarks.peers import work

#: Slots for `sleeps`, hosts or workers for everything else.
SLOTS = 3
#: Calls before a measurement, so that all worker processes have started.
_WARM_UP = 30
_LONGEST_S = 300.0


class Executor(Protocol):
    """Ray, Dask, or a loop."""

    def start(self, function: Callable[[Any], Any], items: Sequence[Any]) -> Any:
        """Submit a call for each item; return a handle on all of them."""

    def results(self, handle: Any) -> list[Any]:
        """Wait for the results."""


#: Makes an executor, of this many calls at the same time.
Opening = Callable[[int], AbstractContextManager[Executor]]
#: Name of a measurement to a function of the number of processes.
Measurements = Mapping[str, Callable[[int], Any]]


def of_executor(opening: Opening) -> Measurements:
    """Return the measurements of what runs functions."""

    def run(name: str, count: int) -> Any:
        with opening(count if name == "holders" else SLOTS) as executor:
            executor.results(executor.start(work.succeed, [None] * _WARM_UP))
            return _OF_EXECUTOR[name](executor, count)

    return {name: partial(run, name) for name in _OF_EXECUTOR}


def main(measurements: Measurements) -> None:
    """Carry out the measurement that the arguments name, and print its result."""
    parser = argparse.ArgumentParser()
    parser.add_argument("measurement", choices=sorted(measurements))
    parser.add_argument("--count", type=int, required=True)
    options = parser.parse_args()
    print(json.dumps(measurements[options.measurement](options.count)), flush=True)


def stamps(executor: Executor, count: int) -> list[float]:
    """Return the milliseconds from each call to the stamp of its process, one at a time."""
    found = []
    for _ in range(count):
        called = time.time_ns()
        (stamp,) = executor.results(executor.start(work.stamp, [None]))
        found.append((stamp - called) / 1e6)
    return found


def jobs(executor: Executor, count: int) -> float:
    """Return the `true` jobs a second, submitted at once."""
    began = time.monotonic()
    executor.results(executor.start(work.succeed, [None] * count))
    return count / (time.monotonic() - began)


def sleeps(executor: Executor, count: int) -> float:
    """Return the makespan of `sleep 0.1`, in times the ideal of all slots."""
    began = time.monotonic()
    executor.results(executor.start(work.sleep, [0.1] * count))
    return (time.monotonic() - began) / (count / SLOTS * 0.1)


def holders(executor: Executor, count: int) -> float:
    """Return the seconds until processes of 40 MB, submitted at once, have filled their memory."""
    with tempfile.TemporaryDirectory(prefix="rosrm-peers-") as folder:
        files = [Path(folder) / str(number) for number in range(count)]
        end = Path(folder) / "end"
        began = time.time_ns()
        handle = executor.start(work.hold, [(40, str(one), str(end)) for one in files])
        try:
            newest = work.wait_for_files(files, _LONGEST_S)
        finally:
            end.touch()
        executor.results(handle)
        return (newest - began) / 1e9


_OF_EXECUTOR: dict[str, Callable[[Executor, int], Any]] = {
    "stamps": stamps, "jobs": jobs, "sleeps": sleeps, "holders": holders,
}  # fmt: skip
