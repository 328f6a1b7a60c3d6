"""Fences at the slave: renewals for the supervisor, and assignments that are too old to start."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rosrm.core.slave import commands as slave_commands
from rosrm.core.slave import events, reducer
from rosrm.core.slave.master_clock import BeatClock
from rosrm.core.slave.state import SlaveState
from rosrm.model.values import (
    Assignment,
    Fence,
    InstanceId,
    InstanceState,
    InstanceStatus,
    ProcessSpec,
)

ONE = InstanceId("p", 1)
FENCE = Fence(after=2.0, grace=1.0)


class Slave:
    """State and clock of a slave that registered at 100 s, its last contact with the master."""

    def __init__(self, **bounds) -> None:
        self.state = SlaveState(**bounds)
        self.now = 100.0
        self.step(events.ContactConfirmed(self.now))
        self.step(events.Registered(1))

    def step(self, event, after=0.0):
        self.now += after
        return list(reducer.step(self.state, event, self.now))

    def assign(self, number=1, fence=FENCE, after=0.0):
        instance = InstanceId("p", number)
        spec = ProcessSpec("p", command=("true",))
        order = events.AssignmentsReceived((Assignment(instance, spec, 1, "p", fence=fence),))
        return self.step(order, after)

    def tell(self, state, number=1, after=0.0):
        status = InstanceStatus(InstanceId("p", number), state, pid=5)
        return self.step(events.SupervisorReported((status,)), after)

    def hears(self, after=0.0):
        self.now += after
        return self.step(events.ContactConfirmed(self.now))


def refusals(commands) -> list[str]:
    reported = [one for c in commands if isinstance(c, slave_commands.Report) for one in c.statuses]
    states = (InstanceState.REFUSED, InstanceState.FENCED)
    return [one.message for one in reported if one.state in states]


def test_the_supervisor_hears_it_while_there_is_a_fence() -> None:
    """Renewals come at most every 0.1 s, and none without a fenced instance."""
    one = Slave()
    one.assign(fence=None)
    assert one.hears(1.0) == []
    one.assign(number=2, after=1.0)
    assert one.hears(0.2) == [slave_commands.Renew(one.now, one.now)]
    assert one.hears(0.05) == []
    assert one.hears(0.06) == [slave_commands.Renew(one.now, one.now)]
    one.tell(InstanceState.EXITED, number=2)
    assert one.hears(1.0) == []


def test_an_older_word_puts_nothing_off() -> None:
    """A delayed beat renews the fence from the time at which it was sent."""
    one = Slave()
    one.assign()
    one.hears(1.0)
    assert one.step(events.ContactConfirmed(one.now - 0.5), 0.5) == [
        slave_commands.Renew(one.now - 0.5, one.now)
    ]
    assert one.state.last_contact == one.now - 0.5


def test_a_fence_is_known_again_from_the_supervisor() -> None:
    """The next run of the slave restores fences. A new supervisor gets the last contact at once."""
    status = InstanceStatus(ONE, InstanceState.RUNNING, pid=5)
    replaced = events.SupervisorReplaced((status,), fenced=frozenset({ONE}))
    one = Slave()
    assert one.step(replaced)[0] == slave_commands.Renew(100.0, 100.0)
    assert one.hears(1.0) == [slave_commands.Renew(101.0, 101.0)]
    new = SlaveState()
    assert reducer.step(new, replaced, 100.0)[0] == slave_commands.Renew(0.0, 100.0)


def test_what_is_given_out_too_late_is_not_started() -> None:
    """The slave was stopped with the order in its sockets: the successor may run by now."""
    one = Slave()
    (message,) = refusals(one.assign(after=2.0))
    assert message.startswith("fenced before it was started: no confirmed contact")
    assert refusals(one.assign(number=2, after=0.0, fence=Fence(2.5, 0.0))) == []


def test_an_answer_that_was_long_on_its_way_starts_nothing() -> None:
    """DDS delivers the answer after a cut, when newer beats have arrived already."""
    one = Slave(max_age=5.0)
    spec = ProcessSpec("p", command=("true",))
    for number, (fence, age, taken) in enumerate(
        [
            (FENCE, 1.9, True),
            (FENCE, 2.0, False),
            (Fence(2.0, 0.0, alive=True), 4.9, True),
            (None, 4.9, True),
            (None, 5.0, False),
        ]
    ):
        given = Assignment(InstanceId("p", number), spec, 1, "p", fence=fence)
        commands = one.step(events.AssignmentsReceived((given,), one.now - age))
        assert any(isinstance(c, slave_commands.Launch) for c in commands) is taken, number
        assert len(refusals(commands)) == (not taken), number


def test_what_waits_for_its_start_is_fenced_too() -> None:
    """A slot that becomes free during a long cut starts no instance that may run elsewhere."""
    one = Slave(max_processes=1)
    one.assign(fence=None)
    one.assign(number=2)
    one.assign(number=3, fence=None)
    assert refusals(one.step(events.TimePassed(), 1.9)) == []
    one.hears()
    assert refusals(one.step(events.TimePassed(), 1.9)) == []
    commands = one.tell(InstanceState.EXITED, after=0.1)
    assert len(refusals(commands)) == 1
    (launch,) = (c for c in commands if isinstance(c, slave_commands.Launch))
    assert [a.instance.number for a in launch.assignments] == [3]
    assert refusals(one.assign(number=2)) == []  # it is remembered, and not started


def test_a_slave_at_work_says_so_while_it_hears_nothing() -> None:
    """Fences with `alive` are renewed by the running slave, so their instances survive a cut."""
    one = Slave()
    alive = Fence(after=2.0, grace=0.0, alive=True)
    (launch,) = one.assign(fence=alive, after=30.0)
    assert isinstance(launch, slave_commands.Launch)
    assert one.step(events.TimePassed(), 1.0) == [slave_commands.Renew(100.0, one.now)]


def test_the_order_to_fence_is_passed_on() -> None:
    """A running instance is killed; an unknown one is never started, as after a stop order."""
    one = Slave()
    one.assign()
    assert one.step(events.FenceOrdered(ONE)) == [slave_commands.Fence(ONE)]
    one.tell(InstanceState.FAILED)
    assert [type(c) for c in one.step(events.FenceOrdered(ONE))] == [slave_commands.Report]
    assert len(refusals(one.step(events.FenceOrdered(InstanceId("p", 2))))) == 1
    assert not any(isinstance(c, slave_commands.Launch) for c in one.assign(number=2))


# --- age of beats -----------------------------------------------------------------------------


def test_beats_that_were_waiting_are_as_old_as_they_are() -> None:
    """After a stop of 30 s the beats of the first second count as 30 s old."""
    clock = BeatClock()
    for tenth in range(10):
        assert clock.sent_at(tenth / 10, 500.0 + tenth / 10) == pytest.approx(500.0 + tenth / 10)
    assert clock.sent_at(1.0, 530.0) == pytest.approx(501.0, abs=0.05)
    assert clock.sent_at(31.0, 531.0) == pytest.approx(531.0, abs=0.05)


@given(
    st.floats(-1e5, 1e5), st.floats(-5e-4, 5e-4),
    st.lists(st.tuples(st.floats(0.05, 100.0), st.floats(0.0, 60.0)), min_size=1, max_size=40),
)  # fmt: skip
def test_a_beat_is_never_taken_as_newer_than_the_quickest_was_quick(ahead, drift, beats) -> None:
    """With any clock offset, drift and delay, the error is at most the least delay."""
    clock = BeatClock()
    said, arrived, quickest = 1000.0, 0.0, 1e9
    for wait, delay in beats:
        said += wait
        arrived = max(arrived, said + delay)  # beats arrive in order
        quickest = min(quickest, arrived - said)
        beat = (said + ahead) * (1 + drift)
        taken = clock.sent_at(beat, arrived)
        assert taken <= arrived + 1e-6
        assert taken - said <= quickest + 2e-3 * (arrived - 1000.0) + 1e-6


def test_another_pace_of_the_clock_makes_no_beat_old() -> None:
    """After an hour of beats from a clock that is 100 ppm slow, the newest counts as new."""
    clock = BeatClock()
    for second in range(0, 3600, 5):
        age = second - clock.sent_at(second * (1 - 1e-4), float(second))
        assert age < 0.01


def test_a_new_greeting_takes_another_clock() -> None:
    """After a sleep of the master's host its beats would otherwise count as an hour old forever."""
    clock = BeatClock()
    clock.sent_at(10.0, 100.0)
    clock.restart()
    assert clock.sent_at(11.0, 3700.0) == 3700.0
