"""Stalls of hosts in the chaos benchmark: measured, confirmed by the master, and judged."""

from __future__ import annotations

import pytest

from benchmarks.chaos.allowances import OVERLOAD, Disturbance, Guarantees
from benchmarks.chaos.outputs import Run
from benchmarks.chaos.rules import judge_service
from benchmarks.chaos.stalls import StallMeter, confirmed

LEASE = 3.0
ONE = Run("a#1", "host1", 5, 9.9, 10.0, 20.0, 1, 100, "active", 20.0)
TWO = Run("a#2", "host2", 6, 20.9, 21.0, 30.0, 101, 200, "active", 30.0)
LOST = [(18.5, "host1")]


def measured(*waits, begun=10.0, step=0.25, host="host1"):
    """Return the stalls of a slave, by the wait that each sample adds; before, it never waited."""
    meter, waited = StallMeter(host, LEASE), 0.0
    meter.add(begun, {"7": 0.0})
    for number, wait in enumerate(waits, 1):
        waited += wait
        meter.add(begun + number * step, {"7": waited})
    return meter.stalls


def violations(stalls, silent=LOST):
    found = confirmed(stalls, silent)
    return [
        one.kind
        for one in judge_service("a", Guarantees(elsewhere=True), [ONE, TWO], found).violations
    ]


#: A slave that waits 95 % of the time from 15.0 to 19.0.
STALLED = measured(*[0.2375] * 16, begun=15.0)


def test_a_move_is_accepted_only_with_a_measured_stall_of_its_host():
    """Neither the record of the master nor the measurement suffices alone."""
    assert violations(STALLED) == []
    assert violations([]) == ["touched"]
    assert violations(STALLED, []) == ["touched"]
    assert violations(measured(*[0.2375] * 16, begun=15.0, host="host3"), LOST) == ["touched"]
    assert violations(STALLED, [(18.5, "host3")]) == ["touched"]


def test_a_process_stalls_with_its_slave():
    """Its last "active" may be as old as the begin of the stall, but hardly older."""
    for begun, found in ((20.5, []), (21.5, ["touched"])):
        stalls = measured(*[0.2375] * 16, begun=begun)
        assert violations(stalls, [(begun + 3.5, "host1")]) == found


@pytest.mark.parametrize("when", [14.9, 19.5])
def test_a_silence_at_another_time_confirms_no_stall(when):
    assert violations(STALLED, [(when, "host1")]) == ["touched"]


def test_a_stall_is_longer_than_the_lease():
    """The kernel adds a wait at its end; waits that are scattered do not add up to a stall."""
    hosts = frozenset({"host1"})
    once = [*[0.0] * 15, 3.9]
    assert measured(*once, begun=15.0) == [
        Disturbance(OVERLOAD, pytest.approx(15.1), 19.0, hosts, hides=True, deafens=True)
    ]
    assert measured(*[0.0] * 15, 2.9) == []
    assert measured(*[0.19] * 100) == []  # 76 % of the time


def test_a_sample_that_comes_late_shows_no_stall():
    """Waits of 4 s within 10 s may be scattered."""
    assert measured(4.0, step=10.0) == []


def test_a_slave_that_was_started_again_is_measured_from_then_on():
    meter = StallMeter("host1", LEASE)
    for second, waited in enumerate(({"7": 0.0}, {}, {"8": 50.0}, {"8": 50.5})):
        meter.add(float(second), waited)
    assert meter.stalls == []
