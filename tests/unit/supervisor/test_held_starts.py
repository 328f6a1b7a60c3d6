"""Held starts of the supervisor's state machine: they begin when another instance has ended.

`test_supervision` tests the guarantees for every order of events.
"""

from __future__ import annotations

import pytest

from rosrm.core.supervisor import events
from rosrm.core.supervisor.commands import Spawn
from rosrm.core.supervisor.instance import BACKOFF, EXITED, FENCED, HELD, STARTING, WITHDRAWN
from rosrm.core.supervisor.reducer import SupervisorState
from rosrm.core.supervisor.rules import FenceRule, RestartRule, StopRule

FIRST, NEXT, LAST = ("first", 1), ("next", 2), ("last", 3)
FENCE = FenceRule(after=10.0, grace=3.0)


def start(core, key, slots=1, restart=RestartRule("never"), fence=None):  # noqa: B008
    """Order a start at time 0; return the instances that are spawned."""
    ordered = events.StartOrdered(key, restart, StopRule(), fence, 0.0, slots)
    return spawns(core.handle(ordered, 0.0))


def spawns(commands):
    """Return the instances that the commands spawn."""
    return [command.instance for command in commands if isinstance(command, Spawn)]


@pytest.fixture
def core():
    """Return a state machine with one running instance, and one that is held for its slot."""
    core = SupervisorState()
    start(core, FIRST, slots=0, restart=RestartRule("on-failure"))
    core.handle(events.Spawned(FIRST, 100), 0.0)
    assert start(core, NEXT, fence=FENCE) == []
    return core


def test_a_held_start_begins_when_the_other_has_ended(core):
    """The end itself is enough: no further order, and no client."""
    assert core.instances[NEXT].phase == HELD
    core.handle(events.ClientLost(), 1.0)
    assert spawns(core.handle(events.Exited(FIRST), 2.0)) == [NEXT]


def test_held_starts_begin_in_order(core):
    """The first one takes the free slot."""
    start(core, LAST)
    assert spawns(core.handle(events.Exited(FIRST), 1.0)) == [NEXT]
    core.handle(events.Spawned(NEXT, 101), 1.0)
    assert spawns(core.handle(events.Exited(NEXT), 2.0)) == [LAST]


def test_a_start_with_a_free_slot_begins_at_once(core):
    """The other may have ended before the order arrived."""
    assert start(core, LAST, slots=2) == [LAST]


def test_an_instance_that_waits_for_its_restart_keeps_its_slot(core):
    """A crashed instance has not ended, so the held start does not run beside its restart."""
    assert spawns(core.handle(events.Exited(FIRST, 1), 1.0)) == []
    assert core.instances[FIRST].phase == BACKOFF


@pytest.mark.parametrize(
    ("event", "phase"),
    [
        (events.StopOrdered(NEXT), EXITED),
        (events.FenceOrdered(NEXT), FENCED),
        (events.TimePassed(), FENCED),
        (events.ShutdownOrdered(), WITHDRAWN),
    ],
    ids=lambda value: type(value).__name__,
)
def test_a_held_start_that_is_stopped_never_begins(core, event, phase):
    """A stop, a fence (in time or by order) and a shutdown end a held start for good."""
    core.handle(event, 10.0)
    instance = core.instances[NEXT]
    assert (instance.phase, instance.run_time) == (phase, 0.0)
    assert spawns(core.handle(events.Exited(FIRST), 11.0)) == []


def test_a_contact_renews_the_fence_of_a_held_start(core):
    """The fence counts from the last contact, as that of a running instance."""
    core.handle(events.ContactReported(9.0), 9.0)
    core.handle(events.TimePassed(), 12.0)
    assert core.instances[NEXT].phase == HELD
    assert core.deadline() == 19.0


def test_an_amended_start_stays_held(core):
    """The new policy applies once it runs."""
    core.handle(events.AmendOrdered(NEXT, RestartRule("always")), 1.0)
    assert spawns(core.handle(events.Exited(FIRST), 2.0)) == [NEXT]
    instance = core.instances[NEXT]
    assert (instance.phase, instance.restart.when) == (STARTING, "always")
