"""What a slave does so that an instance with a fence has ended before a successor starts elsewhere.

The supervisor ends such an instance when it has not been told for too long that the master hears
this host. The slave tells it: it alone hears the master.
"""

from __future__ import annotations

from typing import Final

from rosrm.core.slave.commands import Command, Renew
from rosrm.core.slave.events import MasterHears
from rosrm.core.slave.state import SlaveState
from rosrm.model.values import Assignment, InstanceId

#: Least seconds between two words to the supervisor.
RENEW_PERIOD: Final = 0.1


def master_hears(state: SlaveState, event: MasterHears, now: float) -> list[Command]:
    """Pass it on, where there is a fence that it renews."""
    state.heard_at = max(state.heard_at, event.at)
    return renew_in_time(state, now)


def renew_in_time(state: SlaveState, now: float) -> list[Command]:
    """Tell the supervisor the newest, unless it was told a moment ago."""
    return renew(state, now) if now - state.renewed_at >= RENEW_PERIOD else []


def renew(state: SlaveState, now: float) -> list[Command]:
    """Tell the supervisor the newest; what has no fence needs no word."""
    if not any(held.fenced and not held.status.state.ended for held in state.held.values()):
        return []
    state.renewed_at = now
    return [Renew(state.heard_at, now)]


def too_late(state: SlaveState, assignment: Assignment, now: float) -> str:
    """Why an instance must not be started any more; "": it may be."""
    fence = assignment.fence
    if fence is None or fence.alive or now < state.heard_at + fence.after:
        return ""
    return (
        f"fenced before it was started: for {fence.after:g} s it was not known here whether the "
        f"master hears this host"
    )


def too_old(state: SlaveState, assignment: Assignment, age: float) -> str:
    """Why an assignment that has been on its way for so long is not taken up; "": it is."""
    fence = assignment.fence
    most = state.max_age
    if fence is not None and not fence.alive:
        most = min(most, fence.after)
    if age < most:
        return ""
    return f"given {age:.1f} s ago: it may run elsewhere by now"


def late(state: SlaveState, now: float) -> dict[InstanceId, str]:
    """Those that wait for their start and must not be started any more, and why."""
    return {
        instance: why
        for instance, assignment in state.waiting.items()
        if (why := too_late(state, assignment, now))
    }
