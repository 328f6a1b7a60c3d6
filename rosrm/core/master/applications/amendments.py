"""Changes of running instances, until their slaves have made them."""

from __future__ import annotations

from typing import Final

from rosrm.core.master.events import OrderAnswered
from rosrm.core.master.master_state import MasterState
from rosrm.core.master.state.backoff import Backoff
from rosrm.core.master.state.hosts import HostCondition
from rosrm.core.master.state.pending_orders import InstanceAmendment
from rosrm.core.master.state.process import Instance, PendingAmendment
from rosrm.model.orders import ENDED, NOT_AMENDED, UNKNOWN, AmendInstance
from rosrm.model.values import Amendment, ProcessSpec

#: First and longest time, in seconds, until an order without effect is repeated.
_WAITS: Final = (0.5, 60.0)


def review(state: MasterState, now: float) -> None:
    """Order the changes; repeat orders that were refused or have no answer."""
    for name, pending in list(state.unamended.items()):
        process = state.processes.get(name)
        owner = state.owner_of(process) if process is not None else None
        if process is None or owner is None:
            del state.unamended[name]  # its next instance starts with the new spec
        elif name not in state.migrations and _is_due(state, owner, pending, now):
            pending.backoff.note(now, *_WAITS)
            order = AmendInstance(owner.id, _amendment(process.spec, owner, pending))
            state.send(owner.host, order, InstanceAmendment(owner.id, order.amendment))


def _is_due(state: MasterState, owner: Instance, pending: PendingAmendment, now: float) -> bool:
    is_up = state.hosts.condition_of(owner.host) is HostCondition.UP
    return is_up and now >= pending.backoff.until


def note_answer(
    state: MasterState, change: InstanceAmendment, event: OrderAnswered, now: float
) -> None:
    """Note that a slave has changed an instance, or why it has not."""
    process, owner = (
        state.processes.get(change.instance.process), state.instances.get(change.instance.number)
    )  # fmt: skip
    if process is None or owner is None or process.owner != owner.id.number:
        return
    if event.code in (ENDED, UNKNOWN):
        state.ask_for_report(owner.host, now)  # the status of its end is missing
    pending = state.unamended.get(process.name)
    if pending is None or _amendment(process.spec, owner, pending) != change.amendment:
        return
    application = state.applications.get(process.spec.application)
    task = application.tasks.get(process.name) if application is not None else None
    if event.accepted:
        owner.restarts_off = False
        if pending.limits and change.amendment.limits is None:
            pending.backoff = Backoff()
        else:
            del state.unamended[process.name]
        state.save(process)
    elif event.code == NOT_AMENDED:
        pending.refusal = f"its slave refuses: {event.message}"
        if task is not None:
            task.fault = pending.refusal


def _amendment(spec: ProcessSpec, owner: Instance, pending: PendingAmendment) -> Amendment:
    """Return the change to order next: the restart policy alone if restarts may be off, else all.

    A slave that refuses limits changes nothing. So with limits the order might leave restarts off.
    """
    limits = pending.limits and not owner.restarts_off
    return Amendment(spec.restart, spec.limits if limits else None)
