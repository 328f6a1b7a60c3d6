"""What falls due with time alone: silence, delivery, orders to give again, limits held too long."""

from __future__ import annotations

from typing import Final

from rosrm.core import events as happened
from rosrm.core import lifecycle
from rosrm.core.commands import Order, Withdraw
from rosrm.core.liveness import review_liveness
from rosrm.core.relief import relieve_hosts
from rosrm.core.state import Instance, MasterState, ProcessPhase

#: Seconds between two reviews of what need not be looked at with every event.
_REVIEW_EVERY: Final = 0.2
#: Seconds that a host may owe a status batch before it is asked for everything.
_PATIENCE: Final = 1.0


def time_passed(state: MasterState, event: happened.TimePassed, now: float) -> None:
    """Look at every deadline."""
    review_liveness(state, now)
    if now - state.reviewed < _REVIEW_EVERY:
        return
    state.reviewed = now
    for instance in list(state.instances.values()):
        _review_instance(state, instance, now)
    _ask_for_missing_statuses(state, now)
    relieve_hosts(state, now)


def _review_instance(state: MasterState, instance: Instance, now: float) -> None:
    age = now - instance.since
    process = state.processes[instance.id.process]
    late = instance.state is None and age >= state.settings.delivery_timeout
    if late and process.owner == instance.id.number and process.phase is ProcessPhase.ASSIGNED:
        if now - instance.order_at >= state.settings.delivery_timeout or not instance.order:
            instance.order, instance.order_at = state.order_id(), now
            state.emit(Withdraw(instance.order, instance.host.host_id, instance.id))
    elif instance.stopping and now - instance.order_at >= state.settings.order_retry:
        instance.order, instance.order_at = state.order_id(), now
        state.emit(Order(instance.order, instance.host.host_id, "stop", instance.id))
    if instance.charged.any() and age >= state.settings.settle:
        lifecycle.settle_charge(state, instance, now)


def _ask_for_missing_statuses(state: MasterState, now: float) -> None:
    missing = {int(column) for column in state.hosts.statuses_missing()}
    for column in set(state.missing_since) - missing:
        del state.missing_since[column]
    for column in missing:
        since = state.missing_since.setdefault(column, now)
        if now - since >= _PATIENCE:
            state.missing_since[column] = now
            state.emit(Order(state.order_id(), column + 1, "report"))
