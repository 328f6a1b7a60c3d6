"""What falls due with time alone: silence, delivery, orders to give again, limits held too long."""

from __future__ import annotations

from typing import Final

from rosrm.core.master import events as happened
from rosrm.core.master.assignment.assign import reconsider_set_aside
from rosrm.core.master.assignment.prefetch import review_slots, waits_too_long
from rosrm.core.master.assignment.reservations import settle_charge
from rosrm.core.master.checkpoint import images, periodic, replication
from rosrm.core.master.commands import Order, Redeliver, Withdraw
from rosrm.core.master.hosts import capabilities
from rosrm.core.master.hosts.liveness import review_liveness
from rosrm.core.master.hosts.loss import review_lost_hosts
from rosrm.core.master.lifecycle import stop_instance
from rosrm.core.master.master_state import (
    Instance,
    MasterState,
    Process,
    ProcessPhase,
    Wanted,
)
from rosrm.core.master.migration.eviction import relieve_hosts
from rosrm.core.master.migration.standby import review_standbys
from rosrm.core.master.recovery import journal_gap

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
    review_lost_hosts(state, now)
    journal_gap.review(state, now)
    review_standbys(state, now)
    _ask_for_missing_statuses(state, now)
    capabilities.ask_hosts(state, now)
    images.review(state, now)
    relieve_hosts(state, now)
    replication.review(state, now)
    periodic.review(state, now)
    reconsider_set_aside(state, now)
    state.forget_oldest()


def _review_instance(state: MasterState, instance: Instance, now: float) -> None:
    age = now - instance.since
    if instance.state is None:
        _review_delivery(state, instance, age, now)
    if waits_too_long(instance, now):
        _take_back(state, instance, now)
    if instance.stopping and now - instance.order_at >= state.settings.order_retry:
        stop_instance(state, instance, now)
    if not instance.settled and age >= state.settings.settle:
        settle_charge(state, instance, now)


def _review_delivery(state: MasterState, instance: Instance, age: float, now: float) -> None:
    """Nothing was said of an assignment: the answer that it went with may have been lost."""
    process = state.owned_by(instance)
    if process is None or process.phase is not ProcessPhase.ASSIGNED or instance.stopping:
        return
    if age >= state.settings.delivery_timeout:
        _withdraw(state, process, instance, now)
    elif age >= state.settings.order_retry and not instance.given_again:
        instance.given_again = True
        assignment = state.assignment(instance.id, process.spec)
        state.emit(Redeliver(state.order_id(), instance.host.host_id, assignment))


def _take_back(state: MasterState, instance: Instance, now: float) -> None:
    """An assignment ahead waits for the wrong job: its process goes back to its place."""
    review_slots(state, instance.host, now)
    process = state.owned_by(instance)
    if process is not None and process.wanted is Wanted.RUN and process.name not in state.runs:
        process.wanted = Wanted.REQUEUE
        state.save(process)
        stop_instance(state, instance, now)


def _withdraw(state: MasterState, process: Process, instance: Instance, now: float) -> None:
    """Take back an assignment that was not taken up: however it ends now, it is queued again."""
    if instance.order and now - instance.order_at < state.settings.delivery_timeout:
        return
    if process.wanted is Wanted.RUN:
        process.wanted = Wanted.REQUEUE
        state.save(process)
    instance.order, instance.order_at = state.order_id(), now
    state.emit(Withdraw(instance.order, instance.host.host_id, instance.id))


def _ask_for_missing_statuses(state: MasterState, now: float) -> None:
    missing = {int(column) for column in state.hosts.statuses_missing()}
    for column in set(state.missing_since) - missing:
        del state.missing_since[column]
    for column in missing:
        since = state.missing_since.setdefault(column, now)
        if now - since >= _PATIENCE:
            state.missing_since[column] = now
            state.emit(Order(state.order_id(), column + 1, "report"))
