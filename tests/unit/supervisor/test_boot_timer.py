"""Timer of the boot clock, by which the supervisor sees an expired fence at a resume."""

from __future__ import annotations

import math
import os
import selectors
import sys

import pytest

from rosrm import clocks
from rosrm.supervisor.boot_timer import BootTimer
from tests.limits import no_more_files
from tests.waiting import PATIENCE


@pytest.fixture
def timer():
    timer = BootTimer()
    yield timer
    os.close(timer.descriptor)


def fires(timer: BootTimer, seconds: float = 0.0) -> bool:
    with selectors.DefaultSelector() as selector:
        selector.register(timer.descriptor, selectors.EVENT_READ)
        return bool(selector.select(seconds))


def test_a_deadline_of_the_boot_clock_wakes_a_selector(timer) -> None:
    """The selector wakes at the deadline, long before its own time-out."""
    due = clocks.boot_time() + 0.05
    timer.set(due)
    assert fires(timer, PATIENCE)
    assert clocks.boot_time() >= due


@pytest.mark.parametrize("past", [0.0, -5.0])
def test_a_deadline_that_has_passed_wakes_at_once(timer, past) -> None:
    """After a resume the deadline of a fence may be minutes past."""
    timer.set(past)
    assert fires(timer, PATIENCE)


@pytest.mark.parametrize("none", [None, math.inf, 1e300])
def test_a_later_deadline_replaces_an_earlier_one(timer, none) -> None:
    """Without a deadline, or with one in the far future, nothing wakes the selector."""
    timer.set(0.0)
    assert fires(timer, PATIENCE)
    timer.clear()
    timer.set(none)
    assert not fires(timer)
    timer.clear()  # has no effect, and does not wait


def test_a_machine_without_such_timers_is_no_fault(monkeypatch, capfd) -> None:
    """A filter of system calls may refuse them; the selector then waits by its own time-out."""
    monkeypatch.setitem(sys.modules, "ctypes", None)
    timer = BootTimer()
    timer.set(0.0)
    assert timer.descriptor == -1
    assert "after a suspend of this machine, fences may be late" in capfd.readouterr().err


def test_a_shortage_of_descriptors_is_no_missing_timer() -> None:
    """The caller tries again, as the shortage ends."""
    with no_more_files(), pytest.raises(OSError, match="Too many open files"):
        BootTimer()
