"""A plugin that keeps the master from its work uses up the time-out of no step."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from rosrm.core import events as happened
from rosrm.master import runtime
from rosrm.master.runtime import MasterRuntime


class Clock:
    """Stands for the monotonic clock; deciding takes as long as a test says."""

    def __init__(self, takes: float) -> None:
        self.now, self.takes = 100.0, takes
        self.decided: list[float] = []

    def step(self, _state, _event, now: float) -> list:
        self.decided.append(now)
        self.now += self.takes
        return []


@pytest.mark.parametrize(("takes", "passed"), [(14.0, 0.05), (0.1, 0.15)])
def test_the_time_of_a_long_decision_does_not_count_for_the_core(monkeypatch, takes, passed):
    """No answer is taken in during a long decision; the time of a quick one counts."""
    clock, events = Clock(takes), [[happened.TimePassed()], []]
    monkeypatch.setattr(runtime, "step", clock.step)
    master = MasterRuntime.__new__(MasterRuntime)
    master._state, master._behind = SimpleNamespace(), 0.0
    master._recorder = master._held = None
    master._endpoint = SimpleNamespace(take_events=lambda: events.pop(0))
    monkeypatch.setattr(master, "_now", lambda: clock.now)
    master._take_in(clock.now)
    clock.now += 0.05
    assert clock.decided == [100.0]
    assert master._core_now(clock.now) == pytest.approx(100.0 + passed)
