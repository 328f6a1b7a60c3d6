"""Fences of the supervisor's state machine: time, stop steps and status of a fenced instance.

`test_supervision` tests the guarantees for every order of events.
"""

from __future__ import annotations

import signal

import pytest

from rosrm.core.supervisor import events
from rosrm.core.supervisor.commands import Signal, Unspawn
from rosrm.core.supervisor.instance import BACKOFF, EXITED, FAILED, FENCED, STOPPING
from rosrm.core.supervisor.reducer import SupervisorState
from rosrm.core.supervisor.rules import FenceRule, RestartRule, StopRule

ONE = ("one", 7)
FENCE = FenceRule(after=10.0, grace=3.0)
GRACES = StopRule(interrupt_grace=5.0, terminate_grace=10.0)
ALWAYS = RestartRule("always", delay=1.0)


def ordered(fence=FENCE, restart=ALWAYS, stop=GRACES, heard=None):
    """Return a state machine with a start order at time 0, and its instance."""
    core = SupervisorState()
    core.handle(events.StartOrdered(ONE, restart, stop, fence, heard), 0.0)
    return core, core.instances[ONE]


def running(**options):
    """Return a state machine and its instance, which runs."""
    core, instance = ordered(**options)
    core.handle(events.Spawned(ONE, 100), 0.0)
    return core, instance


def signals(core, until):
    """Return the signals sent until this time without other events, with their times."""
    sent = []
    while (due := core.deadline()) is not None and due <= until:
        commands = core.handle(events.TimePassed(), due)
        sent += [
            (round(due, 3), signal.Signals(command.number).name)
            for command in commands
            if isinstance(command, Signal)
        ]
    return sent


def test_an_instance_without_contact_is_stopped_within_its_fence():
    """The stop steps of its spec apply, shortened to the fence's grace; its status says why."""
    core, instance = running()
    assert signals(core, 13.5) == [(10.0, "SIGINT"), (11.0, "SIGTERM"), (13.0, "SIGKILL")]
    why = "fenced: no confirmed contact with the master for 10 s; "
    steps = "SIGINT, SIGTERM after 1.0 s, SIGKILL after 3.0 s"
    assert instance.message == why + steps
    core.handle(events.Exited(ONE, signal=9), 13.5)
    assert (instance.phase, instance.message) == (FENCED, f"{why}stopped by {steps}")
    assert core.deadline() is None


@pytest.mark.parametrize(
    ("stop", "grace", "sent"),
    [
        (StopRule(0.5, 0.5), 3.0, [(10.0, "SIGINT"), (10.5, "SIGTERM"), (11.0, "SIGKILL")]),
        (GRACES, 0.0, [(10.0, "SIGKILL")]),
    ],
)
def test_graces_are_bounded_by_that_of_the_fence(stop, grace, sent):
    """Graces that are short enough stay; a fence without a grace kills at once."""
    core, _ = running(stop=stop, fence=FenceRule(10.0, grace))
    assert signals(core, sent[-1][0]) == sent


def test_a_late_look_at_the_clock_kills():
    """The supervisor itself was stopped: an instance past its deadline gets no grace."""
    core, _ = running()
    commands = core.handle(events.TimePassed(), 20.0)
    assert [c.number for c in commands if isinstance(c, Signal)] == [signal.SIGKILL]


def test_a_contact_renews_the_fence_from_its_own_time():
    """The deadline counts from the contact, not from the message; older ones have no effect.

    A contact in the future, which is impossible, counts as one of now.
    """
    core, _ = running()
    for contact, now, deadline in ((8.0, 9.5, 18.0), (7.0, 9.6, 18.0), (99.0, 10.0, 20.0)):
        core.handle(events.ContactReported(contact), now)
        assert core.deadline() == deadline


def test_the_clock_begins_with_what_the_start_knows():
    """The master had contact 4 s before; a start without this time counts from itself."""
    core, _ = running(heard=-4.0)
    assert core.deadline() == 6.0
    core, _ = running()
    assert core.deadline() == 10.0


def test_a_contact_after_the_fence_has_begun_is_too_late():
    """The successor may rely on the end of the instance."""
    core, instance = running()
    core.handle(events.TimePassed(), 10.0)
    core.handle(events.ContactReported(10.5), 10.5)
    core.handle(events.Exited(ONE), 10.6)
    assert instance.phase == FENCED


def test_a_restart_by_policy_does_not_put_it_off():
    """The fence's deadline belongs to the host, not to the run."""
    core, instance = running()
    core.handle(events.Exited(ONE, 1), 5.0)
    core.handle(events.TimePassed(), 6.0)
    core.handle(events.Spawned(ONE, 101), 6.0)
    assert core.deadline() == 10.0
    core.handle(events.Exited(ONE, 1), 9.5)
    assert instance.phase == BACKOFF
    core.handle(events.TimePassed(), 10.0)
    assert instance.phase == FENCED
    assert instance.message.endswith("contact with the master for 10 s; "
                                     "it waited for its restart (exit code 1)")  # fmt: skip


def test_a_start_that_waits_its_turn_is_given_up():
    """A start in progress is stopped as soon as it runs."""
    core, instance = ordered()
    assert Unspawn(ONE) in core.handle(events.TimePassed(), 10.0)
    core.handle(events.SpawnFailed(ONE, ""), 10.0)
    assert instance.phase == FENCED
    core, instance = ordered()
    core.handle(events.TimePassed(), 10.0)
    assert Signal(ONE, signal.SIGINT) in core.handle(events.Spawned(ONE, 100), 10.1)
    core, instance = ordered()
    core.handle(events.TimePassed(), 10.0)
    assert Signal(ONE, signal.SIGKILL) in core.handle(events.Spawned(ONE, 100), 13.1)


def test_a_stop_under_way_becomes_as_short():
    """The user ordered the stop before the fence, so the status stays "stopped"."""
    core, instance = running(stop=StopRule(30.0, 30.0))
    core.handle(events.StopOrdered(ONE), 9.0)
    assert signals(core, 13.0) == [(11.5, "SIGTERM"), (13.0, "SIGKILL")]
    core.handle(events.Exited(ONE, signal=9), 13.1)
    assert (instance.phase, instance.message[:10]) == (EXITED, "stopped by")


def test_a_restart_under_way_becomes_an_end():
    """A repeated order to restart changes nothing."""
    core, instance = running()
    core.handle(events.RestartOrdered(ONE), 9.0)
    core.handle(events.TimePassed(), 10.0)
    core.handle(events.RestartOrdered(ONE), 10.1)
    core.handle(events.Exited(ONE), 10.2)
    assert instance.phase == FENCED


@pytest.mark.parametrize(
    ("code", "when", "phase"),
    [(0, "on-failure", EXITED), (1, "never", FAILED), (1, "always", FENCED)],
)
def test_an_instance_that_ended_before_its_fence_keeps_its_end(code, when, phase):
    """A job that completed before the fence has completed; it is not restarted."""
    core, instance = running(restart=RestartRule(when))
    core.handle(events.Exited(ONE, code, leftovers=True), 9.5)
    core.handle(events.TimePassed(), 10.0)
    core.handle(events.SessionEnded(ONE), 10.5)
    assert instance.phase == phase


# --- fence order ----------------------------------------------------------------------------------


def test_the_order_to_fence_kills_what_runs():
    """The order holds with and without an own fence, and prevents a restart."""
    core, instance = running(fence=None)
    assert core.handle(events.FenceOrdered(ONE), 1.0)[-1] == Signal(ONE, signal.SIGKILL)
    core.handle(events.Exited(ONE, signal=9), 1.1)
    assert instance.phase == FENCED
    assert instance.message == "fenced: it has a successor; stopped by SIGKILL"


def test_the_order_to_fence_kills_what_is_being_stopped():
    """One SIGKILL is enough."""
    core, instance = running()
    core.handle(events.StopOrdered(ONE), 1.0)
    assert core.handle(events.FenceOrdered(ONE), 1.5)[-1] == Signal(ONE, signal.SIGKILL)
    assert not any(isinstance(c, Signal) for c in core.handle(events.FenceOrdered(ONE), 1.6))
    core.handle(events.Exited(ONE, signal=9), 1.7)
    assert instance.message == "stopped by SIGINT, SIGKILL after 0.5 s"


def test_the_order_to_fence_ends_what_waits():
    core, instance = running()
    core.handle(events.Exited(ONE, 1), 1.0)
    core.handle(events.FenceOrdered(ONE), 1.1)
    assert instance.phase == FENCED
    core, instance = ordered()
    assert Unspawn(ONE) in core.handle(events.FenceOrdered(ONE), 0.1)
    assert core.handle(events.Spawned(ONE, 100), 0.2)[-1] == Signal(ONE, signal.SIGKILL)


def test_an_instance_fenced_while_it_is_stopped_is_not_restarted_on_order():
    """The instance had failed, and its policy was to decide; now it has a successor."""
    core, instance = running(restart=RestartRule("always"))
    core.handle(events.FailOrdered(ONE, instance.pid, "hung", False), 1.0)
    core.handle(events.FenceOrdered(ONE), 1.5)
    core.handle(events.RestartOrdered(ONE), 2.0)
    core.handle(events.Exited(ONE, signal=9), 2.5)
    assert instance.phase == FENCED


def test_the_first_step_after_a_suspend_ends_a_fenced_instance():
    """A machine that slept longer than the fence and its grace leaves no time for other signals."""
    core, _ = running(heard=0.0)
    core.handle(events.ContactReported(2.0, 2.0), 2.0)
    commands = core.handle(events.TimePassed(), 602.0)
    assert [one.number for one in commands if isinstance(one, Signal)] == [signal.SIGKILL]


def test_a_slave_that_sleeps_too_renews_no_fence():
    """The first report of a slave after a resume has the contact before it, and renews no fence."""
    core, instance = running(heard=0.0)
    core.handle(events.ContactReported(2.0, 602.0), 602.0)
    core.handle(events.TimePassed(), 602.0)
    assert instance.phase == STOPPING


def test_the_reported_run_time_counts_a_suspend_and_all_runs():
    """The master ends a job by this time, whatever its own clock says."""
    core, instance = running(fence=None)
    core.handle(events.Exited(ONE, code=1), 50.0)
    core.handle(events.TimePassed(), core.deadline())
    core.handle(events.Spawned(ONE, 101), 55.0)
    assert (instance.time_run(605.0), instance.run_time) == (605.0, 50.0)
