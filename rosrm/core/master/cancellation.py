"""Cancellation of processes: by a client, or because another process of their group has ended."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from rosrm.core.master import lifecycle
from rosrm.core.master.checkpoint import images
from rosrm.core.master.master_state import MasterState
from rosrm.core.master.state.process import WAITING, DesiredState, Process, ProcessPhase
from rosrm.model.event_kinds import EventKind
from rosrm.model.requester import OPERATOR, Requester
from rosrm.model.values import EMPTY


def cancel(
    state: MasterState, process: Process, now: float, *, cause: str = "",
    by: Requester = OPERATOR, facts: Mapping[str, Any] = EMPTY,
) -> None:  # fmt: skip
    """Remove a process that has not ended from the queue, or stop it.

    Args:
        cause: why it is cancelled without a request of a client; "": a client has requested it.
        by: the client.
        facts: particulars of the cause.
    """
    process.wanted, process.overdue, process.cancel_cause = DesiredState.CANCEL, False, cause
    state.clear_left_behind(process)
    state.gangs.leave(process)
    application = state.applications.get(process.spec.application)
    if not cause and application is not None and application.note_cancelled(process.name):
        state.save_application(application)
    message = f"a cancellation of {process.name} was requested"
    if cause:
        message = f"{process.name} is cancelled: {cause}"
    state.record(now, EventKind.CANCEL_REQUESTED, message, process=process.name, facts=facts, by=by)
    if process.phase in WAITING:
        state.unqueue(process)
        state.set_phase(process, ProcessPhase.CANCELLED, now, cause)
        state.record(
            now, EventKind.CANCELLED, f"{process.name} cancelled in the queue", process=process.name
        )
    elif process.phase is ProcessPhase.SCHEDULED:
        state.set_phase(process, ProcessPhase.CANCELLED, now, process.reason)
        message = f"{process.name} cancelled between two runs: its schedule has ended"
        state.record(now, EventKind.CANCELLED, message, process=process.name)
    elif process.image is not None and process.name not in state.migrations:
        images.cancel(state, process, now)
    elif process.owner == 0 and process.name not in state.migrations:
        # Its owner has ended, and former instances are being stopped.
        if not lifecycle.requeue_if_clear(state, process, now):
            lifecycle.note_awaited_ends(state, process, now)
    elif process.name not in state.migrations:  # otherwise the plan is undone first
        owner = state.instances[process.owner]
        lifecycle.note_phase(state, process, owner, now)
        lifecycle.stop_owner(state, process, owner, now)
    state.save(process)


def kill(state: MasterState, process: Process, now: float, by: Requester) -> None:
    """Order the slaves to kill every instance of a cancelled process (SIGKILL).

    Neither the graces of its `stop` nor dependants or a migration delay the end.
    """
    state.start_orders.last_to_stop.pop(process.name, None)
    if not process.killed and not process.phase.is_terminal:
        message = f"the cancellation of {process.name} is by force: its instances are killed"
        state.record(now, EventKind.CANCEL_REQUESTED, message, process=process.name, by=by)
        process.killed = True
        state.save(process)
    for instance in state.instances_of(process):
        lifecycle.stop_instance(state, instance, now)


def cancel_groups(state: MasterState, now: float) -> None:
    """Cancel the groups of which a process has ended in this step, if its end ends the group.

    A group is that of one user. Of processes that ended together, the first one is the cause.
    """
    ended, state.ended_members = state.ended_members, {}
    for (principal, group), first in ended.items():  # garbage collection may have removed it
        why = f"{first.name} of the group {group} {first.phase.value}"
        facts = {"group": group, "ended": first.name}
        for process in _others(state, principal, group):
            cancel(state, process, now, cause=why, facts=facts)


def _others(state: MasterState, principal: str, group: str) -> list[Process]:
    """Return the processes of a group that have not ended and are not being cancelled."""
    return [
        process for process in state.processes.values()
        if process.spec.group.name == group and process.principal == principal
        and not process.phase.is_terminal and process.wanted is not DesiredState.CANCEL
    ]  # fmt: skip
