"""Changed restart policies of running instances, until their slaves have them."""

from __future__ import annotations

from rosrm.core.master.events import OrderAnswered
from rosrm.core.master.master_state import MasterState
from rosrm.core.master.state.pending_orders import RestartPolicyChange
from rosrm.model.orders import SetRestartPolicy


def review(state: MasterState, now: float) -> None:
    """Order the changed restart policies; repeat orders without an answer."""
    for name, ordered_at in list(state.unamended.items()):
        process = state.processes.get(name)
        owner = state.instances.get(process.owner) if process is not None else None
        if process is None or owner is None:
            del state.unamended[name]  # its next instance starts with the new policy
        elif name not in state.migrations and now - ordered_at >= state.settings.order_retry:
            state.unamended[name] = now
            order = SetRestartPolicy(owner.id, process.spec.restart)
            state.send(owner.host, order, RestartPolicyChange(owner.id, order.restart))


def note_answer(state: MasterState, change: RestartPolicyChange, event: OrderAnswered) -> None:
    """Note that a slave has the restart policy of an instance."""
    process = state.processes.get(change.instance.process)
    if process is None or not event.accepted or process.owner != change.instance.number:
        return
    if process.spec.restart == change.restart and process.name in state.unamended:
        del state.unamended[process.name]
        state.save(process)
