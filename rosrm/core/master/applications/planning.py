"""Plans: the core runs on a copy of its state, whose hosts carry out every order at once."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable
from copy import deepcopy
from dataclasses import dataclass, replace
from typing import Any, Final

from rosrm.core.master import lifecycle
from rosrm.core.master.answers import order_answered
from rosrm.core.master.applications import amendments, rollout
from rosrm.core.master.applications.deadlines import awaits_host
from rosrm.core.master.commands import Assign, Command, PublishStateConfig, SendOrder
from rosrm.core.master.consequences import follow_up
from rosrm.core.master.events import HandoffReported, OrderAnswered
from rosrm.core.master.master_state import MasterState
from rosrm.core.master.migration import handoff
from rosrm.core.master.migration.preemption import preempt
from rosrm.core.master.state.hosts import Host
from rosrm.core.master.state.intents import Unjournaled
from rosrm.core.master.state.process import WAITING, Process, ProcessPhase
from rosrm.core.master.state.spec_changes import changed_fields
from rosrm.model.applications import Action, PlannedAction
from rosrm.model.orders import FenceInstance, StartInstance, StopInstance
from rosrm.model.plan import HandoffPhase, ReportPhase
from rosrm.model.values import EMPTY, InstanceId, InstanceState, InstanceStatus
from rosrm.wording import size

#: Seconds between two rounds of a plan, beyond the time for which a new instance must run well.
_ROUND: Final = 2.0
#: Most rounds; each begins or ends a task, as long as one can be begun.
_MOST_ROUNDS: Final = 10_000
#: States of an instance that its host is starting.
_STARTING: Final = (None, InstanceState.STARTING, InstanceState.RUNNING)
#: Reports of the destination and the source of a handoff after each phase.
_REPORTS: Final = {
    HandoffPhase.SHADOW: (ReportPhase.READY, ReportPhase.ATTACHED),
    HandoffPhase.SWITCH: (ReportPhase.ACTIVE, ReportPhase.RELEASED),
    HandoffPhase.ABORT: (ReportPhase.ABORTED, ReportPhase.RESUMED),
}


@dataclass(frozen=True, slots=True)
class Outlook:
    """What follows a change.

    Attributes:
        actions: in order.
        returns: a sentence on each application that would return to its former version.
        obstacles: phrases on the processes that would find no host, and the returns.
        message: a summary.
    """

    actions: tuple[PlannedAction, ...]
    returns: tuple[str, ...]
    obstacles: tuple[str, ...]
    message: str = ""


def plan(
    state: MasterState, change: Callable[[MasterState], None], requested: Collection[str],
    now: float,
) -> Outlook:  # fmt: skip
    """Return what follows a change; the state does not change.

    Args:
        change: changes a copy of the state.
        requested: names of the requested applications.
    """
    copy = copied(state)
    _finish_orders(copy, now)
    change(copy)
    _run(copy, now)
    returns = tuple(_returns(state, copy))
    obstacles = (*returns, *_without_host(copy, requested))
    return Outlook(tuple(_actions(state, copy, requested)), returns, obstacles)


def _returns(before: MasterState, after: MasterState) -> Iterable[str]:
    for name, application in after.applications.items():
        newest = application.versions.get(application.newest)
        known = before.applications.get(name)
        is_new = known is None or known.newest < application.newest
        if is_new and newest is not None and newest.given_up:
            yield f"{name} would return to version {application.wanted}: {newest.given_up}"


def _without_host(state: MasterState, requested: Collection[str]) -> Iterable[str]:
    """Yield a phrase on each changed process that waits for a host, and not for other processes."""
    for name in requested:
        application = state.applications.get(name)
        for task in application.tasks if application is not None else ():
            process = state.processes.get(task)
            if process is not None and awaits_host(state, process):
                yield f"{task} would wait: {process.reason}"


def copied(state: MasterState) -> MasterState:
    """Return a copy of the state for a plan; immutable values and plugins are shared."""
    shared: list[Any] = [
        state.settings, state.declared, state.placement, state.strategies, state.plugins,
        state.chain_of, state.replication.policy, EMPTY,
    ]  # fmt: skip
    for process in state.processes.values():
        shared += (process.spec, process.next_spec, process.plain, process.decision, process.demand)
        shared.append(process.left_behind)
    for instance in state.instances.values():
        shared += (instance.id, instance.spec, instance.estimated)
    for host in state.hosts.hosts:
        shared.append(host.description)
    for application in state.applications.values():
        shared += application.versions.values()
    shared += state.modes.known.values()
    memo: dict[int, Any] = {id(one): one for one in shared}
    memo[id(state.rankings)], memo[id(state.demands)] = {}, {}
    memo.update((id(one.history), list(one.history)) for one in state.processes.values())
    copy = deepcopy(state, memo)
    copy.settings = replace(
        state.settings, progress_deadline=0.0
    )  # a plan shows waits, not failures
    copy.rankings_version, copy.unsaved = -1, Unjournaled()
    return copy


def _run(state: MasterState, now: float) -> None:
    """Let all tasks proceed until nothing changes any more."""
    lasts = [
        version.rollout.healthy_for
        for application in state.applications.values()
        if (version := application.version) is not None
    ]
    step, before = _ROUND + max(lasts, default=0.0), None
    for _ in range(_MOST_ROUNDS):
        _settle(state, now)
        rollout.review(state, now)
        amendments.review(state, now)
        preempt(state, now)
        _settle(state, now)
        after = _progress(state)
        if after == before:
            return
        before, now = after, now + step


def _progress(state: MasterState) -> Any:
    tasks = [
        (one.wanted, name, task.begun, task.run)
        for one in state.applications.values()
        for name, task in one.tasks.items()
    ]
    return tasks, len(state.instances), len(state.queue), len(state.migrations)


def _settle(state: MasterState, now: float) -> None:
    """Place processes and advance migrations, while hosts carry out every order at once."""
    while True:
        follow_up(state, now)
        effects = [_carried_out(state, command, now) for command in state.take()]
        if not any(effects):
            return


def _finish_orders(state: MasterState, now: float) -> None:
    """Report the effect of the starts and stops that hosts carry out already."""
    launched = {one for move in state.migrations.values() for one in move.launched}
    for instance in list(state.instances.values()):
        if state.hosts.why_unreachable(instance.host):
            continue
        is_sent = instance.id.process not in state.migrations or instance.id.number in launched
        if instance.stopping:
            _report(state, instance.host, instance.id, InstanceState.EXITED, now)
        elif instance.state in _STARTING and is_sent:
            _report(state, instance.host, instance.id, InstanceState.READY, now)


def _carried_out(state: MasterState, command: Command, now: float) -> bool:
    """Report the effect of a command; return False for one without an effect on hosts."""
    match command:
        case Assign(host_id, assignment):
            host = state.hosts.hosts[host_id - 1]
            _report(state, host, assignment.instance, InstanceState.READY, now)
            state.hosts.ask(host)
        case SendOrder(order_id, host_id, order):
            host = state.hosts.hosts[host_id - 1]
            answer = OrderAnswered(order_id, accepted=True)
            order_answered(state, answer, now)
            if isinstance(order, StartInstance):
                _report(state, host, order.instance, InstanceState.READY, now)
            elif isinstance(order, StopInstance | FenceInstance):
                _report(state, host, order.instance, InstanceState.EXITED, now)
        case PublishStateConfig():
            _hand_over(state, command, now)
        case _:
            return False
    return True


def _report(
    state: MasterState, host: Host, instance: InstanceId, condition: InstanceState, now: float
) -> None:
    lifecycle.take_status(state, host, InstanceStatus(instance, condition), now)


def _hand_over(state: MasterState, command: PublishStateConfig, now: float) -> None:
    for phase, number in zip(
        _REPORTS.get(command.phase, ()), (command.destination, command.source), strict=False
    ):
        report = HandoffReported(command.process, command.destination, number, phase)
        handoff.handoff_reported(state, report, now)


def _actions(
    before: MasterState, after: MasterState, requested: Collection[str]
) -> Iterable[PlannedAction]:
    """Yield the differences between two states, in order of submission.

    Args:
        requested: names of the requested applications. Of other processes only the moves are
            differences that the request makes.
    """
    names = dict.fromkeys((*before.processes, *after.processes))
    for name in names:
        old, new = before.processes.get(name), after.processes[name]
        action = _action(before, old, after, new)
        if action is None:
            continue
        if action.application in requested:
            yield action
        elif action.action is Action.MOVE and action.before:
            # Its details are for its owner alone.
            yield replace(action, waits=action.waits.partition("\n")[0], decision=None)


def _action(
    before: MasterState, old: Process | None, after: MasterState, new: Process
) -> PlannedAction | None:
    was, becomes = _host_of(before, old), _host_of(after, new)
    decision = new.decision if old is None or new.decision is not old.decision else None
    pending = _task_reason(after, new)
    waits = new.reason if new.phase in WAITING else pending
    kind = _kind(before, old, new)
    if kind is None and not pending:
        return None
    return PlannedAction(
        new.name, kind or Action.REPLACE, new.spec.application, becomes, was,
        reason=_refusable(before, old, new), fields=_changed(before, old, after, new), waits=waits,
        decision=None if decision is None else dict(decision),
    )  # fmt: skip


def _refusable(before: MasterState, old: Process | None, new: Process) -> str:
    """Return when the host refuses a change of the running instance; "": it does not."""
    owner = before.owner_of(old) if old is not None else None
    limit = new.spec.limits.memory
    if old is None or owner is None or new.owner != old.owner:
        return ""
    if not limit or limit == old.spec.limits.memory:
        return ""
    used = owner.seen.get("memory")
    usage = f", {size(used)} now" if used else ""
    return f"its host refuses a memory limit below the usage{usage}"


def _changed(
    before: MasterState, old: Process | None, after: MasterState, new: Process
) -> tuple[str, ...]:
    """Return the fields in which the desired process differs from the one before."""
    if old is None or old.phase.is_terminal:
        return ()
    application = after.applications.get(new.spec.application)
    specs = application.specs if application is not None else {}
    return changed_fields(before.spec_to_be(old), specs.get(new.name, new.spec))


def _task_reason(state: MasterState, process: Process) -> str:
    application = state.applications.get(process.spec.application)
    task = application.tasks.get(process.name) if application is not None else None
    return task.fault or task.reason if task is not None else ""


def _host_of(state: MasterState, process: Process | None) -> str:
    owner = state.owner_of(process) if process is not None else None
    return owner.host.name if owner is not None else ""


def _kind(before: MasterState, old: Process | None, new: Process) -> Action | None:
    """Return the action between two states of one process; None: nothing was done.

    The end of a migration that was under way before is no action.
    """
    if old is None or (old.phase.is_terminal and new.order != old.order):
        return None if new.phase is ProcessPhase.CANCELLED else Action.START
    if old.phase.is_terminal:
        return None
    if new.phase.is_terminal:
        return Action.STOP
    changes = new.spec != before.spec_to_be(old)
    migration = before.migrations.get(old.name)
    arrived = migration is not None and new.owner == migration.destination.number
    if new.owner != old.owner and not arrived:
        return Action.REPLACE if changes else Action.MOVE
    return Action.CHANGE if changes else None
