"""Restarts in place: each order is repeated until the run for which it was meant has ended.

=================================  =============================================================
observed                           action
=================================  =============================================================
a client, or the restart of a      `RestartInstance`; the run of the owner (pid, restarts) is
dependency, restarts a process     journaled with the process
another run is reported            the restart is done: the stop of the run may have another
                                   cause, after which nothing is started
the same run is still reported     `RestartInstance` again, with back-off, while the host is up and
                                   no status of it is missing
the run has ended before           the process is queued again
the slave refuses the order, or    the restart is given up, which is recorded; that by a dependency
its host is lost                   stays due until the host returns
another instance owns the name     the restart is dropped
=================================  =============================================================
"""

from __future__ import annotations

from typing import Final

from rosrm.core.master import events as happened
from rosrm.core.master.events import OrderOutcome
from rosrm.core.master.master_state import MasterState
from rosrm.core.master.state.hosts import HostCondition
from rosrm.core.master.state.pending_orders import Restart
from rosrm.core.master.state.process import DesiredState, Instance, PendingRestart, Process
from rosrm.model.event_kinds import EventKind
from rosrm.model.orders import STALE, RestartInstance
from rosrm.model.values import InstanceState, InstanceStatus

#: Reported ends other than those by a refusal, a fence or the stop of a slave.
_ENDS: Final = frozenset({InstanceState.EXITED, InstanceState.FAILED})
#: Conditions of a host on which a restart is given up.
_GONE: Final = frozenset({HostCondition.LOST, HostCondition.DETACHED})
#: Longest time, in seconds, between two orders.
_LONGEST_WAIT: Final = 60.0
#: Readings of a host, after which a lost status batch is known to be missing.
_READINGS: Final = 3


def begin(
    state: MasterState, process: Process, owner: Instance, now: float, *, follows: bool = False
) -> None:
    """Order the restart of the owner of a process; `follows`: a dependency was restarted."""
    owner.restarting = PendingRestart(owner.pid, owner.restarts, follows, now)
    _order(state, owner, owner.restarting, now)
    state.save(process)


def _order(state: MasterState, owner: Instance, pending: PendingRestart, now: float) -> None:
    period = float(state.hosts.period[owner.host.column])
    pending.backoff.note(now, max(state.settings.order_retry, _READINGS * period), _LONGEST_WAIT)
    state.send(owner.host, RestartInstance(owner.id, pending.run), Restart(owner.id))


def review(state: MasterState, instance: Instance, now: float) -> None:
    """Repeat an order that has had no effect; give one up that cannot have any."""
    pending, process = instance.restarting, state.owned_by(instance)
    if pending is None:
        return
    if process is None or process.wanted is not DesiredState.RUN:
        _end(state, instance)
    elif (condition := state.hosts.condition_of(instance.host)) in _GONE:
        _give_up(state, process, instance, f"{instance.host.name} {condition.words()}", now)
    elif now >= pending.backoff.until and _may_be_ordered(state, instance):
        _order(state, instance, pending, now)


def _may_be_ordered(state: MasterState, owner: Instance) -> bool:
    """Return True if the newest status of the owner is known, so that it is not restarted twice."""
    return owner.id.process not in state.migrations and state.knows_statuses(owner.host)


def note_status(state: MasterState, instance: Instance, status: InstanceStatus) -> None:
    """End a pending restart if a status shows another run than the one for which it was meant."""
    pending = instance.restarting
    if pending is None:
        return
    is_same = pending.run.is_that_of(status.pid, status.restarts)
    if status.state is InstanceState.STARTING or not is_same:
        _end(state, instance)


def was_missed(instance: Instance, status: InstanceStatus, now: float) -> bool:
    """Return True if a run that no order has ended is older than the pending order to restart it.

    The statuses of a restart may be lost, so the end of a later run may be the first that arrives.
    """
    pending = instance.restarting
    if pending is None or status.state not in _ENDS:
        return False
    return status.run_time >= now - pending.ordered_at


def note_answer(
    state: MasterState, purpose: Restart, event: happened.OrderAnswered, now: float
) -> None:
    """Give a refused restart up; repeat the first order at once if it has no answer."""
    instance = state.instances.get(purpose.instance.number)
    process = state.owned_by(instance) if instance is not None else None
    if instance is None or process is None or instance.restarting is None:
        return
    backoff = instance.restarting.backoff
    has_no_answer = event.outcome is OrderOutcome.TIMEOUT or event.code == STALE
    if has_no_answer and backoff.tries == 1:
        backoff.until = now
        review(state, instance, now)
    elif not has_no_answer and not event.accepted:
        _give_up(state, process, instance, event.reason, now, again=False)


def _end(state: MasterState, instance: Instance) -> None:
    instance.restarting = None
    process = state.processes.get(instance.id.process)
    if process is not None:
        state.save(process)


def _give_up(
    state: MasterState, process: Process, instance: Instance, why: str, now: float,
    *, again: bool = True,
) -> None:  # fmt: skip
    """Give a restart up; `again`: one by a dependency is due again when the host returns."""
    process.restart_due = again and instance.restarting is not None and instance.restarting.follows
    state.record(
        now, EventKind.RESTART_REFUSED, f"{process.name} was not restarted: {why}",
        process=process.name, host=instance.host.name,
    )  # fmt: skip
    _end(state, instance)
