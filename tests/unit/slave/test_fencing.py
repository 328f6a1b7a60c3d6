"""Fences at the slave: renewals for the supervisor, and assignments that are too old to start."""

from __future__ import annotations

from math import inf, nan

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rosrm.core.slave import events
from rosrm.core.slave.commands import Command, Renew, Report
from rosrm.core.slave.commands import Fence as FenceNow
from rosrm.core.slave.master_clock import BeatClock
from rosrm.model.values import Fence, InstanceId, InstanceState, InstanceStatus
from tests.unit.slave.rig import Slave, assignment, launched

ONE = InstanceId("p", 1)
FENCE = Fence(after=2.0, grace=1.0)


def registered(**bounds) -> Slave:
    """Return a slave that registered at 100 s, its last contact with the master."""
    one = Slave(**bounds)
    one.step(events.ContactConfirmed(one.now))
    one.step(events.Registered(1))
    return one


def contact(one: Slave, after: float = 0.0) -> list[Command]:
    return one.step(events.ContactConfirmed(one.now + after), after)


def refusals(commands) -> list[str]:
    reported = [one for c in commands if isinstance(c, Report) for one in c.statuses]
    states = (InstanceState.REFUSED, InstanceState.FENCED)
    return [one.message for one in reported if one.state in states]


def test_a_contact_renews_the_fences_of_the_supervisor() -> None:
    """Renewals come at most every 0.1 s, and none without a fenced instance."""
    one = registered()
    one.assign()
    assert contact(one, 1.0) == []
    one.assign(number=2, fence=FENCE, after=1.0)
    assert contact(one, 0.2) == [Renew(one.now, one.now)]
    assert contact(one, 0.05) == []
    assert contact(one, 0.06) == [Renew(one.now, one.now)]
    one.status(InstanceState.EXITED, number=2)
    assert contact(one, 1.0) == []


def test_an_older_beat_does_not_count() -> None:
    """A delayed beat moves no fence: the newest contact counts."""
    one = registered()
    one.assign(fence=FENCE)
    contact(one, 1.0)
    newest = one.now
    assert one.step(events.ContactConfirmed(newest - 0.5), 0.5) == [Renew(newest, one.now)]
    assert one.state.last_contact == newest


@pytest.mark.parametrize("at", [inf, nan, 1e9])
def test_a_contact_in_the_future_counts_as_one_of_now_at_most(at) -> None:
    """Otherwise the fence would never end an instance that has a successor."""
    one = registered()
    one.assign(fence=FENCE)
    one.step(events.ContactConfirmed(at), 1.0)
    assert one.state.last_contact <= one.now


def test_a_fence_is_known_again_from_the_supervisor() -> None:
    """The next run of the slave restores fences. A new supervisor gets the last contact at once."""
    status = InstanceStatus(ONE, InstanceState.RUNNING, pid=5)
    replaced = events.SupervisorReplaced((status,), fenced=frozenset({ONE}))
    one = registered()
    assert one.step(replaced)[0] == Renew(100.0, 100.0)
    assert contact(one, 1.0) == [Renew(101.0, 101.0)]
    assert Slave().step(replaced)[0] == Renew(0.0, 100.0)


def test_a_late_assignment_starts_nothing() -> None:
    """The successor may run by now, because the slave was stopped or a cut delayed the answer.

    DDS delivers the answer after a cut, when newer beats have arrived already.
    """
    one = registered(max_age=5.0)
    alive = Fence(2.0, 0.0, alive=True)
    for number, (fence, age, starts) in enumerate(
        [(FENCE, 1.9, True), (FENCE, 2.0, False), (alive, 4.9, True), (None, 4.9, True),
         (None, 5.0, False)]
    ):  # fmt: skip
        given = assignment(number=number, fence=fence)
        commands = one.step(events.AssignmentsReceived((given,), one.now - age))
        assert bool(launched(commands)) is starts, number
        assert len(refusals(commands)) == (not starts), number
    (message,) = refusals(one.assign(number=9, fence=FENCE, after=2.0))
    assert message.startswith("fenced before it was started: no confirmed contact")
    assert launched(one.assign(number=10, fence=Fence(2.5, 0.0)))


def test_what_waits_for_its_start_is_fenced_too() -> None:
    """A slot that becomes free during a long cut starts no instance that may run elsewhere."""
    one = registered(max_processes=1)
    for number, fence in ((1, None), (2, FENCE), (3, None)):
        one.assign(number=number, fence=fence)
    assert refusals(one.step(events.TimePassed(), 1.9)) == []
    contact(one)
    assert refusals(one.step(events.TimePassed(), 1.9)) == []
    commands = one.status(InstanceState.EXITED, after=0.1)
    assert len(refusals(commands)) == 1
    assert launched(commands) == [InstanceId("p", 3)]
    assert refusals(one.assign(number=2, fence=FENCE)) == []  # it is remembered, and not started


def test_a_running_slave_renews_alive_fences_without_contact() -> None:
    """Fences with `alive` are renewed by the running slave, so their instances survive a cut."""
    one = registered()
    assert launched(one.assign(fence=Fence(after=2.0, grace=0.0, alive=True), after=30.0))
    assert one.step(events.TimePassed(), 1.0) == [Renew(100.0, one.now)]


def test_the_order_to_fence_is_passed_on() -> None:
    """A running instance is killed; an unknown one is never started, as after a stop order."""
    one = registered()
    one.assign(fence=FENCE)
    assert one.step(events.FenceOrdered(ONE)) == [FenceNow(ONE)]
    one.status(InstanceState.FAILED)
    assert [type(c) for c in one.step(events.FenceOrdered(ONE))] == [Report]
    assert len(refusals(one.step(events.FenceOrdered(InstanceId("p", 2))))) == 1
    assert launched(one.assign(number=2, fence=FENCE)) == []


# --- age of beats -----------------------------------------------------------------------------


def test_delayed_beats_count_with_their_true_age() -> None:
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
def test_the_age_of_a_beat_errs_by_the_least_delay_at_most(ahead, drift, beats) -> None:
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


def test_clock_drift_makes_no_beat_old() -> None:
    """After an hour of beats from a clock that is 100 ppm slow, the newest counts as new."""
    clock = BeatClock()
    for second in range(0, 3600, 5):
        age = second - clock.sent_at(second * (1 - 1e-4), float(second))
        assert age < 0.01


def test_a_new_session_takes_another_clock() -> None:
    """After a sleep of the master's host its beats would otherwise count as an hour old forever."""
    clock = BeatClock()
    clock.sent_at(10.0, 100.0)
    clock.restart()
    assert clock.sent_at(11.0, 3700.0) == 3700.0
