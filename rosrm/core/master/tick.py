"""Tick: periodic work of the reducer (silence, delivery, repeated orders, limits)."""

from __future__ import annotations

from typing import Final

from rosrm.core.master import answers, restarts
from rosrm.core.master import events as happened
from rosrm.core.master.applications import amendments, rollout
from rosrm.core.master.assignment.assign import reconsider_set_aside
from rosrm.core.master.assignment.prefetch import review_slots, waits_too_long
from rosrm.core.master.assignment.reservations import review_reservation
from rosrm.core.master.checkpoint import images, periodic, replication
from rosrm.core.master.commands import Redeliver, Withdraw
from rosrm.core.master.garbage import collect_garbage
from rosrm.core.master.hosts import capabilities, links
from rosrm.core.master.hosts.liveness import review_liveness
from rosrm.core.master.hosts.loss import review_lost_hosts
from rosrm.core.master.hosts.registration import review_departures
from rosrm.core.master.lifecycle import gone, stop_instance
from rosrm.core.master.master_state import REPORT_WAITS, MasterState
from rosrm.core.master.migration.eviction import evict_from_hosts
from rosrm.core.master.migration.preemption import preempt
from rosrm.core.master.migration.rebalancing import review_rebalancing
from rosrm.core.master.migration.reunion import review_separated
from rosrm.core.master.migration.standby import review_standbys
from rosrm.core.master.modes import switching
from rosrm.core.master.recovery import journal_gap
from rosrm.core.master.rescheduling import review_refusals
from rosrm.core.master.schedules import review_schedules
from rosrm.core.master.start_order import review_stops
from rosrm.core.master.state.backoff import Backoff
from rosrm.core.master.state.hosts import HostCondition
from rosrm.core.master.state.process import DesiredState, Instance, Process, ProcessPhase
from rosrm.core.master.time_limits import review_time_limits
from rosrm.model.orders import ReportInstances

#: Seconds between two ticks; this work need not be done with every event.
_REVIEW_EVERY: Final = 0.2
#: Seconds for which a status batch may be missing before the slave must report all statuses.
_PATIENCE: Final = 1.0
#: Periods of its readings in which a host reports a status batch that it has sent.
_READINGS_LATE: Final = 3


def time_passed(state: MasterState, event: happened.TimePassed, now: float) -> None:
    """Check every deadline."""
    review_liveness(state, now)
    if now - state.reviewed < _REVIEW_EVERY:
        return
    state.reviewed = now
    answers.review(state, now)
    _ask_for_missing_statuses(state, now)
    for instance in list(state.instances.values()):
        _review_instance(state, instance, now)
    amendments.review(state, now)
    rollout.review(state, now)
    review_time_limits(state, now)
    review_schedules(state, now)
    review_stops(state, now)
    review_departures(state, now)
    review_lost_hosts(state, now)
    journal_gap.review(state, now)
    review_standbys(state, now)
    _review_forged_batches(state, now)
    capabilities.ask_hosts(state, now)
    links.ask_next_host(state, now)
    images.review(state, now)
    review_separated(state, now)
    evict_from_hosts(state, now)
    switching.review(state, now)  # by the limits that are exceeded now
    preempt(state, now)
    review_rebalancing(state, now)
    replication.review(state, now)
    periodic.review(state, now)
    review_refusals(state, now)
    reconsider_set_aside(state, now)
    collect_garbage(state)


def _review_instance(state: MasterState, instance: Instance, now: float) -> None:
    age = now - instance.since
    if instance.state is None:
        _review_delivery(state, instance, age, now)
    if waits_too_long(state, instance, now):
        _cancel_prefetch(state, instance, now)
    # A host that is away gets the order when it registers, or at the first tick after its return.
    is_due = instance.stopping and now - instance.order_at >= state.settings.order_retry
    if is_due and not state.hosts.why_unreachable(instance.host):
        stop_instance(state, instance, now)
    restarts.review(state, instance, now)
    review_reservation(state, instance, now)
    if _never_arrived(state, instance, age):
        _give_up(state, instance, age, now)


def _review_delivery(state: MasterState, instance: Instance, age: float, now: float) -> None:
    """Redeliver or withdraw an assignment without a report, because it may be lost on its way."""
    process = state.owned_by(instance)
    if process is None or process.phase is not ProcessPhase.ASSIGNED or instance.stopping:
        return
    if age >= state.settings.delivery_timeout:
        _withdraw(state, process, instance, now)
    elif age >= state.settings.order_retry and not instance.redelivered:
        instance.redelivered = True
        assignment = state.assignment(instance.id, process.spec)
        order_id = state.pending_orders.add()
        state.emit(Redeliver(order_id, instance.host.host_id, assignment))


def _cancel_prefetch(state: MasterState, instance: Instance, now: float) -> None:
    """Return a prefetched process to the queue, because its slot stays taken."""
    review_slots(state, instance.host, now)
    process = state.owned_by(instance)
    if process is None or process.name in state.migrations:
        return
    if process.wanted is DesiredState.RUN:
        process.wanted = DesiredState.REQUEUE
        state.save(process)
        stop_instance(state, instance, now)


def _withdraw(state: MasterState, process: Process, instance: Instance, now: float) -> None:
    """Withdraw an assignment that was not accepted; its process is queued again in any case."""
    if now - instance.order_at < state.settings.delivery_timeout:
        return
    if process.wanted is DesiredState.RUN:
        process.wanted = DesiredState.REQUEUE
        state.save(process)
    instance.order_at = now
    state.emit(Withdraw(state.pending_orders.add(), instance.host.host_id, instance.id))


def _never_arrived(state: MasterState, instance: Instance, age: float) -> bool:
    """Return True if an instance does not exist, because its host reports for so long without it.

    A slave refuses an assignment that is older than `control.max_age`. A host that is silent, or of
    which a status is missing, may have the instance.
    """
    host = instance.host
    if instance.state is not None or age < state.settings.delivery_timeout + state.settings.lease:
        return False
    if instance.id.process in state.migrations or instance.id.process in state.standbys:
        return False  # their plans have their own time-outs
    is_up = state.hosts.condition_of(host) is HostCondition.UP
    return is_up and (host.unreached or state.knows_statuses(host))


def _give_up(state: MasterState, instance: Instance, age: float, now: float) -> None:
    """Drop an instance that never arrived; its host gets no work until it answers an order."""
    host = instance.host
    if not host.unreached:
        host.unreached = True
        state.hosts.set_report_due(host, report_due=True)
        state.ask_for_report(host, now)
    gone(state, instance, now, f"{host.name} did not answer within {age:.0f} s")


def _ask_for_missing_statuses(state: MasterState, now: float) -> None:
    missing = {int(column) for column in state.hosts.statuses_missing()}
    for column in set(state.missing_since) - missing:
        del state.missing_since[column]
    for column in missing:
        since = state.missing_since.setdefault(column, now)
        if now - since >= _PATIENCE:
            state.reports_awaited.setdefault(column, Backoff())
    for column, awaited in state.reports_awaited.items():
        host = state.hosts.hosts[column]
        if now >= awaited.until and state.hosts.condition_of(host) is HostCondition.UP:
            awaited.note(now, *REPORT_WAITS)
            state.send(host, ReportInstances())


def _review_forged_batches(state: MasterState, now: float) -> None:
    """Ask a host for all statuses if its readings do not know the newest status batch.

    Another sender has sent that batch, and its sequence hides the batches that the host sends.
    """
    table, since = state.hosts, state.ahead_since
    for column in [one for one, (_, batch) in since.items() if table.reported[one] >= batch]:
        del since[column]
    for column in map(int, table.statuses_ahead()):
        began, _ = since.setdefault(column, (now, int(table.status_sequence[column])))
        if now - began >= max(_PATIENCE, _READINGS_LATE * float(table.period[column])):
            del since[column]
            table.status_sequence[column] = table.reported[column]
            state.ask_for_report(table.hosts[column], now)
