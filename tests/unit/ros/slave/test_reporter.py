"""Reporting of readings: which cycles are sent at once; no cycle is lost from the count."""

from __future__ import annotations

from array import array

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rosrm.model.values import RESOURCE_SLOTS
from rosrm.ros.master.reading_decoder import decode
from rosrm.ros.master.reading_stats import ReadingStats
from rosrm.ros.slave.reporter import RESOLUTION, Reporter

RUN = 77
HOST = 3
PERIOD = 0.1
FACTS = (True, 2, 0b11, 0, 5)  # accepting, processes, present, stale, newest status sequence


class Slave:
    """Reporter of one slave, with the messages that it sent."""

    def __init__(self, beat_period: float = 1.0) -> None:
        self.sent: list[bytes] = []
        self.reporter = Reporter(self.sent.append, RUN, PERIOD)
        self.reporter.begin(HOST, beat_period)
        self.usage = np.zeros(RESOURCE_SLOTS, np.float32)
        self.limit = np.ones(RESOURCE_SLOTS, np.float32)
        self.usage[:2] = 0.5
        self.limit[:2] = 0.8

    def cycle(self, facts=FACTS) -> int:
        """Run one cycle and return the number of messages sent in it."""
        before = len(self.sent)
        self.reporter.cycle(array("f", self.usage), array("f", self.limit), facts)
        return len(self.sent) - before


def test_the_first_reading_is_always_published() -> None:
    """A master that has just accepted a host must not wait for it, on a rejoin either."""
    slave = Slave()
    assert [slave.cycle() for _ in range(3)] == [1, 0, 0]

    slave.reporter.begin(HOST, 1.0)
    assert slave.cycle() == 1


@pytest.mark.parametrize(("beat_period", "every"), [(1.0, 10), (0.3, 3), (0.2, 2), (0.05, 1)])
def test_unchanged_readings_are_published_once_per_beat_period(
    beat_period: float, every: int
) -> None:
    """However little changes, the master receives a message that often, and counts each cycle."""
    slave = Slave(beat_period)
    slave.cycle()
    sent = [slave.cycle() for _ in range(3 * every)]

    assert sent == ([0] * (every - 1) + [1]) * 3
    runs = decode(slave.sent).runs
    assert runs.sequence.tolist() == runs.cycles.tolist() == [1 + 3 * every]


@pytest.mark.parametrize(
    "facts",
    [
        (False, *FACTS[1:]),
        (True, 3, 0b11, 0, 5),
        (True, 2, 0b111, 0, 5),
        (True, 2, 0b11, 0b10, 5),
        (True, 2, 0b11, 0, 6),
    ],
    ids=["accepting", "processes", "present", "stale", "statuses"],
)
def test_a_change_that_matters_is_published_in_its_own_cycle(facts) -> None:
    """Changes of acceptance, load, late probes and statuses are sent at once, and once."""
    slave = Slave()
    slave.cycle()
    slave.cycle()

    assert slave.cycle(facts) == 1
    assert slave.cycle(facts) == 0


def test_a_limit_that_is_reached_left_or_changed_is_published_at_once() -> None:
    """Placement compares with it; the size of the step across the limit makes no difference."""
    slave = Slave()
    slave.usage[0] = 0.799
    slave.cycle()

    for value in (0.801, 0.7995):
        slave.usage[0] = value
        assert slave.cycle() == 1
        assert decode(slave.sent[-1:]).readings.usage[0, 0] == np.float32(value)
    slave.limit[1] = 0.9
    assert slave.cycle() == 1


def test_a_slow_drift_is_published_when_it_adds_up() -> None:
    """The master's value is never further off than the resolution, however small the steps are."""
    slave = Slave(beat_period=10.0)
    slave.cycle()
    for _ in range(60):
        slave.usage[1] += 0.3 * RESOLUTION
        slave.cycle()
        said = decode(slave.sent[-1:]).readings.usage[0, 1]
        assert abs(said - slave.usage[1]) < RESOLUTION


def test_the_newest_reading_can_be_published_early() -> None:
    """Messages that rely on the reading (such as a satisfied need) follow it; it is sent once."""
    slave = Slave()
    slave.cycle()
    slave.usage[0] += 0.5 * RESOLUTION
    slave.cycle()

    slave.reporter.publish()
    slave.reporter.publish()

    assert len(slave.sent) == 2
    decoded = decode(slave.sent)
    assert decoded.readings.usage[0, 0] == slave.usage[0]
    assert decoded.runs.cycles.tolist() == [2]


@given(
    steps=st.lists(st.floats(-0.02, 0.02), min_size=1, max_size=80),
    lost=st.sets(st.integers(0, 79)),
    batch=st.integers(1, 7),
)
def test_each_cycle_is_either_accounted_for_or_missed(steps, lost, batch) -> None:
    """Both sides count the same cycles, whatever is idle and whatever is lost."""
    slave, ledger = Slave(beat_period=0.4), ReadingStats()
    ledger.begin(HOST, RUN)
    for step in steps:
        slave.usage[0] = np.clip(slave.usage[0] + np.float32(step), 0.0, 1.0)
        slave.cycle()
    came = [raw for number, raw in enumerate(slave.sent) if number == 0 or number not in lost]
    for begin in range(0, len(came), batch):
        ledger.take(decode(came[begin : begin + batch]).runs, now=0.0)

    last = decode(came[-1:]).runs
    assert ledger.cycles + ledger.missed == last.sequence[0]
    assert (ledger.missed == 0) == (came == slave.sent[: len(came)])
