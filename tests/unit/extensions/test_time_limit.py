"""Time limits of plugin calls: what they leave behind."""

from __future__ import annotations

import gc
import signal
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from rosrm.extensions.time_limit import limited

#: Objects and KiB that further calls may leave; caches of Python and of the test runner grow, too.
OBJECTS = 500
KIB = 2_048


@pytest.fixture(autouse=True)
def _no_outer_limit() -> Iterator[None]:
    """Stop the timer of the test runner, as a master has none around its calls."""
    left = signal.setitimer(signal.ITIMER_REAL, 0.0)
    before = signal.signal(signal.SIGALRM, signal.SIG_DFL)
    yield
    signal.signal(signal.SIGALRM, before)
    signal.setitimer(signal.ITIMER_REAL, *left)


def _late() -> str:
    return "late"


def _fail() -> None:
    raise ValueError("no")


def _calls(number: int) -> None:
    for _ in range(number):
        limited(1.0, int, _late)
        with pytest.raises(ValueError, match="no"):
            limited(1.0, _fail, _late)


def _memory() -> int:
    return int(Path("/proc/self/statm").read_text().split()[1]) * 4


def test_calls_leave_no_objects_and_no_memory() -> None:
    """Thousands of limited calls, successful and failed ones, leave nothing behind."""
    _calls(200)
    gc.collect()
    objects, memory = len(gc.get_objects()), _memory()
    _calls(3_000)
    gc.collect()
    assert len(gc.get_objects()) - objects < OBJECTS
    assert _memory() - memory < KIB


def test_late_calls_leave_no_objects() -> None:
    """Interrupted calls leave nothing behind either."""

    def late_calls(number: int) -> None:
        for _ in range(number):
            with pytest.raises(TimeoutError):
                limited(0.001, lambda: time.sleep(5.0), _late)

    late_calls(20)
    gc.collect()
    objects = len(gc.get_objects())
    late_calls(200)
    gc.collect()
    assert len(gc.get_objects()) - objects < OBJECTS


def test_an_outer_handler_is_restored() -> None:
    """The handler that the process had for the alarm is in force again after the call."""

    def own(_number: int, _frame: object) -> None:
        raise AssertionError

    before = signal.signal(signal.SIGALRM, own)
    try:
        limited(1.0, int, _late)
        assert signal.getsignal(signal.SIGALRM) is own
    finally:
        signal.signal(signal.SIGALRM, before)


def test_the_limit_of_an_outer_call_remains() -> None:
    """A limited call within a limited call does not end the limit of the outer one."""

    def outer() -> None:
        limited(5.0, int, _late)
        time.sleep(5.0)

    with pytest.raises(TimeoutError, match="outer"):
        limited(0.1, outer, lambda: "outer")
