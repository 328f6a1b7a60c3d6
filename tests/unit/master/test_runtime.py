"""Slow plugins do not count against the time-out of a step; the younger of two masters stops."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from rosrm import clocks
from rosrm.core.master import events as happened
from rosrm.master import runtime
from rosrm.master.runtime import MasterRuntime


class Clock:
    """Fake monotonic clock; a decision and its plugins take the time set by the test."""

    def __init__(self, takes: float, plugins: float) -> None:
        self.now, self.takes, self.plugins = 100.0, takes, plugins
        self.spent = 0.0  # as in `Deadlines`
        self.decided: list[float] = []

    def step(self, _state, _event, now: float) -> list:
        self.decided.append(now)
        self.now += self.takes
        self.spent += self.plugins
        return []


@pytest.mark.parametrize(
    ("takes", "plugins", "passed"), [(14.0, 14.0, 0.05), (0.1, 0.1, 0.15), (14.0, 0.1, 14.05)]
)
def test_the_time_of_slow_plugins_does_not_count_for_the_core(monkeypatch, takes, plugins, passed):
    """No answer is handled while a plugin is slow. Time of quick plugins and of a disk counts."""
    clock, events = Clock(takes, plugins), [[happened.TimePassed()], []]
    monkeypatch.setattr(runtime, "step", clock.step)
    master = MasterRuntime.__new__(MasterRuntime)
    master._state, master._behind = SimpleNamespace(queue=[]), 0.0
    master._recorder = master._held = None
    master._deadlines = clock
    master._endpoint = SimpleNamespace(
        take_events=lambda queued: events.pop(0), poll_first_readings=lambda: None
    )
    monkeypatch.setattr(master, "_now", lambda: clock.now)
    master._take_in(clock.now)
    clock.now += 0.05
    assert clock.decided == [100.0]
    assert master._core_now(clock.now) == pytest.approx(100.0 + passed)


@pytest.mark.parametrize(("slept", "passed"), [(600.0, 1.0), (0.05, 601.0)])
def test_a_suspend_of_the_machine_makes_no_host_silent(monkeypatch, slept, passed) -> None:
    """The master received nothing in the suspend, and must not give up all hosts afterwards."""
    master = MasterRuntime.__new__(MasterRuntime)
    monkeypatch.setattr("rosrm.clocks.suspended_time", lambda: 30.0)
    master._behind, master._held, master._suspends = 0.0, None, clocks.Suspends()
    before = master._core_now(100.0)
    monkeypatch.setattr("rosrm.clocks.suspended_time", lambda: 30.0 + slept)
    master._leave_out_suspend()
    master._leave_out_suspend()
    assert master._core_now(701.0) - before == pytest.approx(passed)


def test_awaited_readings_are_polled_once_in_a_turn(monkeypatch) -> None:
    """Otherwise slaves that report without a pause would delay the beats of the master."""
    polls, events = [], [["registered"], ["asked"], []]
    monkeypatch.setattr(runtime, "step", lambda *_: [])
    master = MasterRuntime.__new__(MasterRuntime)
    master._state, master._behind = SimpleNamespace(queue=[]), 0.0
    master._recorder = master._held = None
    master._deadlines = SimpleNamespace(spent=0.0)
    master._endpoint = SimpleNamespace(
        take_events=lambda queued: events.pop(0), poll_first_readings=lambda: polls.append(1)
    )
    monkeypatch.setattr(master, "_now", lambda: 0.0)
    master._take_in(0.0)
    assert (polls, events) == ([1], [])


@pytest.mark.parametrize(("loss", "wait"), [(100.02, 0.02), (99.0, 0.005), (float("inf"), 0.05)])
def test_the_loop_wakes_at_the_end_of_a_lease(loss, wait) -> None:
    """A past end, which the core keeps during a stall, occupies no core with ticks."""
    master = MasterRuntime.__new__(MasterRuntime)
    master._state, master._behind, master._held = SimpleNamespace(next_loss=loss), 0.0, None
    assert min(0.05, master._until_loss(100.0)) == pytest.approx(wait)


@pytest.mark.parametrize(
    ("uptime", "incarnation", "stops"),
    [
        (10.0, 1, False), (200.0, 1, True), (100.2, 7, False), (99.8, 9, True),
        (float("nan"), 9, False), (float("-inf"), 9, False),
    ],
)  # fmt: skip
def test_the_younger_of_two_masters_stops(uptime, incarnation, stops) -> None:
    """After simultaneous starts the greater incarnation stays. An impossible uptime stops none."""
    master = MasterRuntime.__new__(MasterRuntime)
    master._started, master._stopping = 0.0, ""
    master._endpoint = SimpleNamespace(incarnation=8)
    rival = SimpleNamespace(
        uptime=uptime, incarnation=incarnation, name="m", pid=9, hostname="elsewhere"
    )
    master._judge_rival(rival, 100.0)
    assert bool(master._stopping) is stops
