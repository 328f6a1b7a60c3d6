"""Fences on the slave's side: a fenced instance ends before a successor starts elsewhere.

The supervisor ends an instance with a fence when too much time has passed since the last contact
with the master. The slave sends the last contact to the supervisor, because only the slave receives
beats.
"""

from __future__ import annotations

from typing import Final

from rosrm.core.slave.commands import Command, Renew
from rosrm.core.slave.events import ContactConfirmed
from rosrm.core.slave.state import SlaveState
from rosrm.model.values import Assignment, InstanceId

#: Shortest time, in seconds, between two `Renew` commands to the supervisor.
RENEW_PERIOD: Final = 0.1


def contact_confirmed(state: SlaveState, event: ContactConfirmed, now: float) -> list[Command]:
    """Note the last contact, and renew the fences."""
    state.last_contact = max(state.last_contact, min(event.at, now))
    return renew_in_time(state, now)


def renew_in_time(state: SlaveState, now: float) -> list[Command]:
    """Renew the fences, at most once per `RENEW_PERIOD`."""
    return renew(state, now) if now - state.renewed_at >= RENEW_PERIOD else []


def renew(state: SlaveState, now: float) -> list[Command]:
    """Send the last contact to the supervisor, if a live instance has a fence."""
    if not any(held.fenced for held in state.alive.values()):
        return []
    state.renewed_at = now
    return [Renew(state.last_contact, now)]


def too_late(state: SlaveState, assignment: Assignment, now: float) -> str:
    """Return why the fence of an instance forbids its start; "" if it may start."""
    fence = assignment.fence
    if fence is None or fence.alive or now < state.last_contact + fence.after:
        return ""
    return (
        f"fenced before it was started: no confirmed contact with the master for {fence.after:g} s"
    )


def too_old(state: SlaveState, assignment: Assignment, age: float) -> str:
    """Return why an assignment of this age (seconds) is not accepted; "" if it is."""
    fence = assignment.fence
    most = state.max_age
    if fence is not None and not fence.alive:
        most = min(most, fence.after)
    if age < most:
        return ""
    return f"given {age:.1f} s ago: it may run elsewhere by now"


def late(state: SlaveState, now: float) -> dict[InstanceId, str]:
    """Return the waiting instances that must not start any more, with the reason."""
    return {
        instance: why
        for instance, assignment in state.waiting.items()
        if (why := too_late(state, assignment, now))
    }
