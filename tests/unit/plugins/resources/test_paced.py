"""Readings whose cost grows with the number of processes."""

from __future__ import annotations

import pytest

from rosrm.testing import FakeClock
from rosrm_resources import paced
from rosrm_resources.paced import Paced


class Costly:
    """A reading that costs CPU time, which the test sets."""

    def __init__(self, monkeypatch) -> None:
        self.cost = self.spent = 0.0
        self.clock = FakeClock()
        self.reads = 0
        monkeypatch.setattr(paced.time, "thread_time", lambda: self.spent)
        self.paced = Paced(self.read, self.clock)

    def read(self, _now: float) -> float:
        self.reads += 1
        self.spent += self.cost
        return float(self.reads)

    def for_seconds(self, seconds: float) -> int:
        """Ask ten times a second; return the number of readings."""
        before = self.reads
        for _ in range(round(seconds * 10)):
            self.clock.advance(0.1)
            self.paced.value()
        return self.reads - before


@pytest.fixture
def costly(monkeypatch):
    return Costly(monkeypatch)


def test_a_cheap_reading_is_made_each_time(costly) -> None:
    """A tree of a few hundred processes is read at the full rate."""
    costly.cost = 0.003
    assert costly.for_seconds(5.0) == 50


@pytest.mark.parametrize("cost", [0.01, 0.04, 0.2])
def test_a_costly_reading_takes_a_small_share_of_a_core(costly, cost) -> None:
    """A tree of thousands of processes is read less often, and never left unread."""
    costly.cost = cost
    costly.for_seconds(20.0)
    spent = costly.spent
    reads = costly.for_seconds(100.0)
    assert 0 < costly.spent - spent < 4.5
    assert costly.paced.value() == costly.reads
    assert reads > 0


def test_one_slow_reading_changes_no_pace(costly) -> None:
    """Otherwise one garbage collection would prevent readings for a second."""
    costly.for_seconds(1.0)
    costly.cost = 0.5
    assert costly.for_seconds(0.1) == 1
    costly.cost = 0.0
    assert costly.for_seconds(1.0) == 10
