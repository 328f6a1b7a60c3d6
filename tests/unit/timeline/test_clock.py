"""Seconds of events."""

from __future__ import annotations

from dataclasses import replace

from rosrm.model.rows import EventRow
from rosrm.timeline.clock import EventClock

FIRST = EventRow(1, 1.7e9, 5.0, "master_started", "", "", "")


def test_times_continue_over_a_restart_of_the_master():
    """The pause of the master is measured by unix time; a clock set back leaves the order."""
    second = replace(FIRST, kind="host_lost", elapsed=9.0, wall_time=1.7e9 + 4)
    third = replace(FIRST, elapsed=0.0, wall_time=1.7e9 + 24)
    fourth = replace(third, kind="host_back", elapsed=3.0)

    clock = EventClock()
    assert [clock.take(one) for one in (FIRST, second, third, fourth)] == [0.0, 4.0, 24.0, 27.0]
    clock, back = EventClock(), replace(third, wall_time=0.0)
    assert [clock.take(one) for one in (FIRST, second, back)] == [0.0, 4.0, 4.0]


def test_the_present_time_follows_the_master():
    """Seconds since the master's start become seconds of the timeline, and unix time."""
    clock = EventClock()
    clock.take(FIRST)
    clock.take(replace(FIRST, elapsed=1.0, wall_time=1.7e9 + 60))  # it was restarted

    assert clock.at(3.0) == clock.newest + 2.0
    assert clock.wall_time(clock.newest + 2.0) == 1.7e9 + 62
    assert clock.seconds(1.7e9 + 62) == clock.newest + 2.0
