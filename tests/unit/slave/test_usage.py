"""Usage of each instance: sessions that are followed, and time of the report."""

from __future__ import annotations

import pytest

from rosrm.model.values import InstanceId, InstanceState, InstanceStatus
from rosrm.slave.sessions import SessionUsage
from rosrm.slave.usage import UsageWatch

P = InstanceId("p", 7)


class Table:
    """Fake table of sessions: its members, and the ends that it received."""

    def __init__(self) -> None:
        self.leaders: list[int] = []
        self.removed: list[tuple[int, float]] = []
        self.looks = 0

    def add(self, leader: int, group: object) -> None:
        self.leaders.append(leader)

    def remove(self, leader: int, cpu_time: float) -> None:
        self.removed.append((leader, cpu_time))
        if leader in self.leaders:
            self.leaders.remove(leader)

    def refresh(self, now: float) -> None:
        self.looks += 1

    def members(self, leader: int) -> tuple[int, ...]:
        return (leader, leader + 1)

    def usage(self) -> dict[int, SessionUsage]:
        return {leader: SessionUsage(0.5, 1000 + leader) for leader in self.leaders}


@pytest.fixture
def table() -> Table:
    return Table()


def told(state: InstanceState, pid: int = 0, cpu_time: float = 0.0) -> InstanceStatus:
    return InstanceStatus(P, state, pid=pid, cpu_time=cpu_time)


def test_usage_is_reported_three_readings_after_its_measurement(table) -> None:
    """Each usage is reported once, and is not measured again before its report."""
    watch = UsageWatch(table, lambda _: None)
    watch.follow(told(InstanceState.RUNNING, 40))
    watch.look(1.0, {})
    watch.look(1.5, {})
    said = [watch.after_reading() for _ in range(4)]
    assert said == [{}, {}, {7: SessionUsage(0.5, 1040)}, {}]
    assert table.looks == 1


def test_the_usage_of_a_session_is_that_of_its_processes(table) -> None:
    """A probe measures processes, of which a session may have several."""
    watch = UsageWatch(table, lambda _: None)
    watch.follow(told(InstanceState.RUNNING, 40))
    watch.look(1.0, {2: {40: 1.0, 41: 2.0, 50: 4.0}, 3: {}})
    *_, said = [watch.after_reading() for _ in range(3)]
    assert said[7].others == {2: 3.0, 3: 0.0}


def test_nothing_is_looked_at_while_nothing_runs(table) -> None:
    """An idle host has no overhead."""
    watch = UsageWatch(table, lambda _: None)
    watch.look(1.0, {})
    assert (table.looks, watch.after_reading()) == (0, {})


def test_a_session_is_followed_from_its_start_to_its_end(table) -> None:
    """A restart is a new session; an ended session hands over its CPU time."""
    watch = UsageWatch(table, lambda _: None)
    watch.follow(told(InstanceState.RUNNING, 40))
    watch.follow(told(InstanceState.BACKOFF, cpu_time=2.0))
    watch.follow(told(InstanceState.RUNNING, 41))
    watch.follow(told(InstanceState.STOPPING, 41))
    assert table.leaders == [41]
    watch.follow(told(InstanceState.EXITED, cpu_time=3.0))
    assert (table.leaders, table.removed) == ([], [(40, 2.0), (41, 3.0)])


def test_one_that_ended_before_this_slave_started_does_not_count(table) -> None:
    """The hours of CPU time of a recorded end are no present load."""
    UsageWatch(table, lambda _: None).follow(told(InstanceState.EXITED, cpu_time=3600.0))
    assert table.removed == []
