"""Stalls in the chaos benchmark: measured, confirmed by a record, and judged."""

from __future__ import annotations

import json
from dataclasses import replace

import pytest

from benchmarks.chaos.allowances import OVERLOAD, Disturbance, Guarantees
from benchmarks.chaos.faults import MASTER
from benchmarks.chaos.outputs import Run
from benchmarks.chaos.rules import judge_service
from benchmarks.chaos.stalls import StallMeter, before_fences, confirmed, read_fences

LEASE = 3.0
ONE = Run("a#1", "host1", 5, 9.9, 10.0, 20.0, 1, 100, "active", 20.0)
TWO = Run("a#2", "host2", 6, 20.9, 21.0, 30.0, 101, 200, "active", 30.0)
LOST = [(18.5, "host1")]
ELSEWHERE = Guarantees(elsewhere=True)
ISOLATED = Guarantees(elsewhere=True, isolated=True)


def measured(*waits, begun=10.0, step=0.25, part="host1"):
    """Return the stalls of a part, by the wait that each sample adds; before, it never waited."""
    meter, waited = StallMeter(part, LEASE), 0.0
    meter.add(begun, {"7": 0.0})
    for number, wait in enumerate(waits, 1):
        waited += wait
        meter.add(begun + number * step, {"7": waited})
    return meter.stalls


def violations(stalls, silent=LOST):
    return judged(confirmed(stalls, silent, LEASE))


def judged(disturbances, guarantees=ELSEWHERE, runs=(ONE, TWO)):
    return [one.kind for one in judge_service("a", guarantees, runs, disturbances).violations]


#: A slave that waits 95 % of the time from 15.0 to 19.0.
STALLED = measured(*[0.2375] * 16, begun=15.0)


def test_a_move_is_accepted_only_with_a_measured_stall_of_its_host():
    """Neither the record of the master nor the measurement suffices alone."""
    assert violations(STALLED) == []
    assert violations([]) == ["touched"]
    assert violations(STALLED, []) == ["touched"]
    assert violations(measured(*[0.2375] * 16, begun=15.0, part="host3"), LOST) == ["touched"]
    assert violations(STALLED, [(18.5, "host3")]) == ["touched"]


def test_a_process_stalls_with_its_slave():
    """Its last "active" may be as old as the begin of the stall, but hardly older."""
    for begun, found in ((20.5, []), (21.5, ["touched"])):
        stalls = measured(*[0.2375] * 16, begun=begun)
        assert violations(stalls, [(begun + 3.5, "host1")]) == found


@pytest.mark.parametrize("when", [14.9, 19.5])
def test_a_silence_at_another_time_confirms_no_stall(when):
    assert violations(STALLED, [(when, "host1")]) == ["touched"]


def test_a_host_is_lost_only_in_a_stall_longer_than_its_lease():
    stalls = measured(*[0.2375] * 11, begun=16.0)
    assert [(one.begun, one.ended) for one in stalls] == [(16.0, 18.75)]
    assert violations(stalls) == ["touched"]


def test_a_stall_has_few_moments_without_a_wait():
    """The kernel adds a wait at its end; waits that are scattered do not add up to a stall."""
    hosts = frozenset({"host1"})
    once = [*[0.0] * 15, 3.9]
    assert measured(*once, begun=15.0) == [
        Disturbance(OVERLOAD, pytest.approx(15.1), 19.0, hosts, hides=True, deafens=True)
    ]
    assert measured(*[0.0] * 15, 0.75) == []
    assert measured(*[0.19] * 100) == []  # 76 % of the time


def test_a_sample_that_comes_late_shows_no_stall():
    """Waits of 4 s within 10 s may be scattered."""
    assert measured(4.0, step=10.0) == []


def test_a_slave_that_was_started_again_is_measured_from_then_on():
    meter = StallMeter("host1", LEASE)
    for second, waited in enumerate(({"7": 0.0}, {}, {"8": 50.0}, {"8": 50.5})):
        meter.add(float(second), waited)
    assert meter.stalls == []


#: An instance that waited 95 % of the time from 19.0 to 20.25, and was fenced.
SHORT = measured(*[0.2375] * 5, begun=19.0)
FENCED = {
    "record": "state", "key": ["a", 1], "phase": "stopping", "heard": 18.9,
    "fence": [1.425, 0.475, True], "fenced": "fenced: no activity of its slave for 1.425 s",
}  # fmt: skip


def record(**changes):
    """Return the instance record of a host with the fence of an instance."""
    lines = [{"record": "header", "version": 1}, {**FENCED, "phase": "running", "fenced": ""}]
    lines += [{**FENCED, **changes}, {**FENCED, **changes, "phase": "fenced"}]
    return "".join(f"{json.dumps(line)}\n" for line in lines)


def after_fence(stalls, text, host="host1", **more):
    return judged(before_fences(stalls, read_fences(host, text)), **more)


def test_a_fence_is_accepted_only_with_a_measured_stall_of_its_host():
    """Neither the record of the host nor the measurement suffices alone."""
    assert after_fence(SHORT, record()) == []
    assert after_fence([], record()) == ["touched"]
    assert after_fence(SHORT, "") == ["touched"]
    assert after_fence(measured(*[0.2375] * 5, begun=19.0, part="host3"), record()) == ["touched"]
    assert after_fence(SHORT, record(), host="host3") == ["touched"]


def test_a_fence_explains_the_end_of_its_instance_only():
    assert after_fence(SHORT, record(key=["a", 2])) == ["touched"]
    assert after_fence(SHORT, record(key=["b", 1])) == ["touched"]
    assert after_fence(SHORT, record(), guarantees=Guarantees()) == ["touched"]  # it has no fence


@pytest.mark.parametrize(
    ("count", "begun"),
    [(3, 19.0), (5, 17.5), (5, 20.0)],
    ids=["short", "before", "after"],
)
def test_a_fence_needs_a_stall_in_its_own_silence(count, begun):
    assert after_fence(measured(*[0.2375] * count, begun=begun), record()) == ["touched"]


def test_a_fence_against_a_successor_is_no_lost_contact():
    assert after_fence(SHORT, record(fenced="fenced: it has a successor")) == ["touched"]


def test_a_stall_of_the_master_explains_no_fence_for_a_silent_slave():
    """The slave has to work for such a fence; other fences need the master."""
    stalls = measured(*[0.2375] * 5, begun=19.0, part=MASTER)
    assert after_fence(stalls, record()) == ["touched"]
    assert after_fence([], record(), guarantees=ISOLATED) == ["touched"]
    assert after_fence(stalls, record(), guarantees=ISOLATED) == []
    assert confirmed(measured(*[0.2375] * 16, begun=15.0, part=MASTER), LOST, LEASE) == []


def test_a_fence_allows_no_second_owner():
    """A successor starts after the end of a fenced instance."""
    beside = replace(TWO, first=19.5)
    assert after_fence(SHORT, record(), runs=(ONE, beside)) == ["doubled"]


def test_an_incomplete_line_of_a_record_is_left_out():
    assert read_fences("host1", record() + json.dumps(FENCED)[:-9]) == read_fences(
        "host1", record()
    )
