"""Suspends of the machine."""

from __future__ import annotations

import pytest

from rosrm import clocks


def test_each_suspend_counts_once(monkeypatch):
    """Each suspend is reported once; the time between two reads of the clocks is no suspend."""
    slept = [100.0]
    monkeypatch.setattr(clocks, "suspended_time", lambda: slept[0])
    suspends = clocks.Suspends()
    slept[0] = 100.05
    assert suspends.new() == 0.0
    slept[0] = 160.0
    assert suspends.new() == pytest.approx(60.0)
    assert suspends.new() == 0.0
    slept[0] = 161.0
    assert suspends.new() == pytest.approx(1.0)
