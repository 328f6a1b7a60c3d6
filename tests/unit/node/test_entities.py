"""Wrappers of an author's entities, without ROS."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from rosrm.node.entities import TimerOf

SECOND = 10**9


@pytest.mark.parametrize(
    ("due", "first"), [(0.25, SECOND // 4), (-3.0, 1), (5.0, SECOND), (2**63 / 1e9, SECOND)]
)
def test_a_timer_first_runs_within_its_period(due, first):
    """A mark may be forged, and a timer that is due in 292 years never runs."""
    timer = SimpleNamespace(timer_period_ns=SECOND, reset=lambda: None)
    one = TimerOf(timer, started=True)
    one.start_in(due)
    assert timer.timer_period_ns == first
    one.back_in_step()
    assert timer.timer_period_ns == SECOND
