"""Requests of clients: submit, cancel, restart, migrate, checkpoint, restore, cordon, drain."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from collections.abc import Set as AbstractSet
from typing import Final

from rosrm.core.master import events as happened
from rosrm.core.master import restarts
from rosrm.core.master.adoption import check_adoption
from rosrm.core.master.assignment.assign import assign_to_adopt, reconsider_set_aside
from rosrm.core.master.assignment.gangs import check_gangs
from rosrm.core.master.assignment.neighbours import running_with
from rosrm.core.master.cancellation import cancel, kill
from rosrm.core.master.checkpoint import image_requests
from rosrm.core.master.commands import Reply
from rosrm.core.master.contradictions import neighbour_fault
from rosrm.core.master.dependants import dependants_first
from rosrm.core.master.graph_names import node_of, shared_nodes
from rosrm.core.master.hosts.registration import save_host
from rosrm.core.master.master_state import MasterState
from rosrm.core.master.migration.eviction import departures, try_move
from rosrm.core.master.migration.rebalancing import begin_round, plan_round
from rosrm.core.master.migration.start import why_busy, why_not_selected
from rosrm.core.master.outcomes import Rejected, RequestRefused
from rosrm.core.master.process_defaults import with_defaults
from rosrm.core.master.quotas import check_quota, processes_fault
from rosrm.core.master.rescheduling import allow_every_host
from rosrm.core.master.rights import check_rights
from rosrm.core.master.schedules import await_first_run, queue_again
from rosrm.core.master.scheduling.feasibility import unknown_resources
from rosrm.core.master.start_order import dependants_fault, start_order_fault
from rosrm.core.master.state.hosts import Host
from rosrm.core.master.state.process import WAITING, DesiredState, Process, ProcessPhase
from rosrm.core.master.stores import check_number, check_store, make_room
from rosrm.errors import PluginError, plain_text
from rosrm.extensions.contracts import SpecChecking
from rosrm.extensions.declared_fields import container_conflict, standby_conflict, unshared
from rosrm.extensions.plugin_calls import implements, required
from rosrm.model.adoption_rules import adoption_fault
from rosrm.model.event_kinds import EventKind
from rosrm.model.limits import limits_fault
from rosrm.model.requester import Requester
from rosrm.model.stop_rules import stop_fault
from rosrm.model.values import InstanceState, ProcessSpec
from rosrm.wording import MOST_COMPARED, counted, listed, no_such

#: Kind of the record of each action on a host.
_HOST_EVENTS: Final = {
    "cordon": EventKind.HOST_CORDONED,
    "uncordon": EventKind.HOST_UNCORDONED,
    "drain": EventKind.HOST_DRAINING,
}


# --- submit -----------------------------------------------------------------------------------


def submission_received(state: MasterState, event: happened.SubmissionReceived, now: float) -> None:
    """Queue all of the processes, or refuse all."""
    named = [state.processes[spec.name] for spec in event.specs if spec.name in state.processes]
    check_rights(named, event.by)
    _refuse_parts(event.specs)
    taken = _taken(state, event)
    if taken:
        raise RequestRefused(f"{taken}. Nothing was queued", "name_taken")
    filled = [with_defaults(spec, state.settings.process_defaults) for spec in event.specs]
    specs = [spec for spec, _ in filled]
    fault = (
        submission_fault(state, filled)
        or neighbour_fault(state, specs, event.by.name)
        or start_order_fault(state, specs)
        or dependants_fault(state, specs, event.by.name)
    )
    if fault:
        raise RequestRefused(f"{fault}. Nothing was queued")
    check_gangs(state, specs, event.by.name, specs)
    check_quota(state, specs, event.by)
    check_store(state, specs, event.by.name, is_operator=event.by.is_operator)
    adopted = {spec.name: spec.adoption for spec in specs if spec.adoption.host}
    for adoption in adopted.values():
        check_adoption(state, adoption, now)
    processes = [add_process(state, spec, defaulted, event.by, now) for spec, defaulted in filled]
    make_room(state, event.by.name, is_operator=event.by.is_operator)
    for process in processes:
        if process.name in adopted:
            assign_to_adopt(state, process, now)
    own = {one.name: one.node for one in processes}
    others = {name: node for node in own.values() for name in state.nodes.get(node, ())}
    doubts = shared_nodes({**own, **others}.items())
    doubts += unknown_resources(state.hosts, specs)
    warnings = "".join(f". Warning: {one}" for one in doubts)
    state.emit(Reply(event.request, message=f"{_accepted(processes)}{warnings}"))


def _accepted(processes: Sequence[Process]) -> str:
    """Return the outcome of a submission: "2 processes queued; 1 waits for its first run"."""
    later = sum(process.phase is ProcessPhase.SCHEDULED for process in processes)
    if not later:
        return f"{count(len(processes))} queued"
    waiting = f"{count(later)} {'waits' if later == 1 else 'wait'} for the first run"
    queued = len(processes) - later
    return f"{count(queued)} queued; {waiting}" if queued else waiting


def add_process(
    state: MasterState, spec: ProcessSpec, defaulted: tuple[str, ...], by: Requester, now: float
) -> Process:
    """Queue a new process; it replaces an ended one of its name.

    Args:
        defaulted: paths of the fields that have the cluster's defaults.
        by: its owner from now on.
    """
    process = Process(
        spec, state.next_order, ProcessPhase.QUEUED, now, by.name, by.is_operator, wall=state.wall,
        born=state.next_instance, owned_from=_owned_from(state, spec.name, by),
        defaulted=defaulted, awaits_gang=bool(spec.together),
    )  # fmt: skip
    state.next_order += 1
    state.add_process(process)
    if not await_first_run(state, process, now):
        state.put_in_queue(process)
    message = f"{process.name} was submitted"
    state.record(now, EventKind.SUBMITTED, message, process=process.name, by=by)
    state.save(process)
    return process


def _refuse_parts(specs: Sequence[ProcessSpec]) -> None:
    """Refuse processes that are parts of an application, which only `apply` may change."""
    names = dict.fromkeys(spec.application for spec in specs if spec.application)
    if names:
        raise RequestRefused(
            f"these are processes of the application {listed(names)}: use `rosrm apply FILE`, or "
            f"remove `app:` from the file. Nothing was queued"
        )


def _owned_from(state: MasterState, name: str, by: Requester) -> int:
    """Return the lowest number of an instance since a name belongs to the user that submits it."""
    former = state.processes.get(name)
    if former is not None and former.principal == by.name:
        return former.owned_from
    return state.next_instance


def _taken(state: MasterState, event: happened.SubmissionReceived) -> str:
    """Return why the submitted names cannot be used; "" if they can."""
    if len({spec.name for spec in event.specs}) < len(event.specs):
        twice = [name for name, n in Counter(spec.name for spec in event.specs).items() if n > 1]
        return f"submitted twice at once: {listed(twice)}; names are unique"
    taken = [
        spec.name for spec in event.specs
        if spec.name in state.processes and not state.processes[spec.name].phase.is_terminal
    ]  # fmt: skip
    if taken:
        return "; ".join(_in_use(state, taken))
    for spec in event.specs:
        if spec.name in state.processes:
            left = still_stopping(state, spec.name)
            if left:
                return left
    return ""


def _in_use(state: MasterState, taken: list[str]) -> list[str]:
    """Return sentences on the live processes that use the names, and how to free the names."""
    live = [name for name in taken if state.processes[name].wanted is not DesiredState.CANCEL]
    ending: dict[str, list[str]] = {}
    for name in taken:
        if name not in live:
            ending.setdefault(state.processes[name].reason, []).append(name)
    phrases = [f"{_names(alike)} still in use: {reason}" for reason, alike in ending.items()]
    if live:
        phrases.append(
            f"{_names(live)} in use already; `rosrm cancel` with the name or the file cancels "
            f"{'it' if len(live) == 1 else 'them'}"
        )
    return phrases


def _names(names: list[str]) -> str:
    return f"the name {names[0]} is" if len(names) == 1 else f"the names {listed(names)} are"


def still_stopping(state: MasterState, name: str) -> str:
    """Return a sentence on an earlier instance that may still run; "" for none."""
    process = state.processes.get(name)
    if process is None or not process.instances:
        return ""
    instance = state.instances[min(process.instances)]
    return f"an earlier {instance.id} is still being stopped on {instance.host.name}"


def submission_fault(
    state: MasterState, submitted: Sequence[tuple[ProcessSpec, tuple[str, ...]]],
    superseded: AbstractSet[str] = frozenset(),
) -> str:  # fmt: skip
    """Return why specs, each with the paths of its defaults, are refused; "": they are not.

    `superseded`: as in `check_quota`.
    """
    fault = processes_fault(state, [spec.name for spec, _ in submitted], superseded=superseded)
    if fault:
        return fault
    for spec, defaulted in submitted:
        fault = _spec_fault(state, spec)
        if fault:
            return f"{spec.name}: {fault}{_origin(defaulted)}"
    return _shared_container(state, [spec for spec, _ in submitted if spec.components])


def _shared_container(state: MasterState, submitted: Sequence[ProcessSpec]) -> str:
    """Return a sentence on containers of one name; "": there are none.

    In DDS each of them would execute a request to load a component.
    """
    if not submitted:
        return ""
    own = {spec.name for spec in submitted}
    others = (
        (one.name, one.node) for one in state.processes.values()
        if one.spec.components and one.name not in own and not one.phase.is_terminal
    )  # fmt: skip
    shared = shared_nodes([*((spec.name, node_of(spec)) for spec in submitted), *others])
    return f"two containers would load the same components: {shared[0]}" if shared else ""


def _spec_fault(state: MasterState, spec: ProcessSpec) -> str:
    """Return why limits, migration, standby or container of a spec are refused; "": not."""
    fault = limits_fault(spec) or adoption_fault(spec) or stop_fault(spec)
    if fault:
        return fault
    strategy = spec.migration.strategy
    if strategy is not None and strategy not in state.strategies:
        return why_not_selected(state, strategy)
    fault = _strategy_fault(state, spec)
    if fault:
        return f"migration by {strategy!r}: {fault}"
    able = state.declared.capabilities_of(spec)
    standby_fault = standby_conflict(spec, able, state.declared.capabilities)
    return standby_fault or container_conflict(spec, able)


#: Paths of the fields that `_spec_fault` checks.
_CHECKED: Final = ("migration.", "standby.", "limits.", "needs", "cpus", "realtime.", "nice")


def _origin(defaulted: Sequence[str]) -> str:
    """Return the part of a refusal that names the fields with defaults of the cluster, if any."""
    concerned = [path for path in defaulted if path.startswith(_CHECKED)]
    if not concerned:
        return ""
    given = "is" if len(concerned) == 1 else "are"
    return f" ({listed(concerned)} {given} given by `defaults.process` of the cluster)"


def _strategy_fault(state: MasterState, spec: ProcessSpec) -> str:
    """Return why the strategy of a spec cannot move the process; "": no reason is known."""
    name = spec.migration.strategy or ""
    strategy: object = state.strategies.get(name)
    if strategy is None:
        return ""

    def fault_of() -> str:
        try:
            state.declared.options_of(name, spec)
        except ValueError as fault:
            return plain_text(str(fault), lines=True)
        if not implements(strategy, SpecChecking):
            return ""
        return required(strategy.spec_fault(unshared(spec)), str)

    try:
        return state.plugins.ask("migration", name, "spec_fault", fault_of, strategy)
    except PluginError as error:
        return f"its check of this process failed: {error}"


def count(number: int) -> str:
    """Return a number of processes: "1 process", "3 processes"."""
    return counted(number, "process", "processes")


# --- cancel, restart --------------------------------------------------------------------------


def known_processes(state: MasterState, names: Iterable[str], by: Requester) -> list[Process]:
    """Return the processes of these names; refuse unknown names, and processes of others."""
    unknown = [name for name in names if name not in state.processes]
    if unknown:
        newest = list(state.processes)[-MOST_COMPARED:]
        raise RequestRefused(no_such("process", unknown, newest), "unknown")
    processes = [state.processes[name] for name in dict.fromkeys(names)]
    check_rights(processes, by)
    return processes


def cancel_requested(state: MasterState, event: happened.CancelRequested, now: float) -> None:
    """Remove processes from the queue, or stop them."""
    processes = known_processes(state, event.names, event.by)
    terminal = [process.name for process in processes if process.phase.is_terminal]
    for process in dependants_first(state, processes):
        if not process.phase.is_terminal and not (event.at_once and _is_cancelled(process)):
            cancel(state, process, now, by=event.by)
        if event.at_once:
            kill(state, process, now, event.by)
    state.emit(Reply(event.request, message=_cancelled(state, processes, terminal)))


def _is_cancelled(process: Process) -> bool:
    return process.wanted is DesiredState.CANCEL


def _cancelled(state: MasterState, processes: Iterable[Process], terminal: list[str]) -> str:
    """Return the outcome of a cancellation; `terminal`: names that had ended before."""
    asked = [process for process in processes if process.name not in terminal]
    pending = [process for process in asked if not process.phase.is_terminal]
    phrases = [f"{count(len(asked) - len(pending))} cancelled"] if len(asked) > len(pending) else []
    if pending:
        phrases.append(f"{count(len(pending))} being cancelled")
    phrases += [
        f"{process.name} is {process.reason}"
        for process in pending
        if (owner := state.owner_of(process)) is not None
        and state.hosts.why_unreachable(owner.host)
    ]
    if terminal:
        phrases.append(f"ended before: {listed(terminal)}")
    return "; ".join(phrases)


def restart_requested(state: MasterState, event: happened.RestartRequested, now: float) -> None:
    """Restart running processes in place; queue ended ones again."""
    processes = known_processes(state, event.names, event.by)
    for process in processes:
        fault = _restart_fault(state, process)
        if fault:
            raise RequestRefused(f"{fault}. Nothing was restarted")
    ended = [one for one in processes if one.phase.is_terminal]
    starting = [one.spec for one in ended]
    fault = start_order_fault(state, starting)
    fault = fault or processes_fault(state, [one.name for one in ended])
    if fault:
        raise RequestRefused(f"{fault}. Nothing was restarted")
    for owner in dict.fromkeys(one.principal for one in ended):
        own = [one for one in ended if one.principal == owner]
        fault = neighbour_fault(state, [one.spec for one in own], owner)
        if fault:
            raise RequestRefused(f"{fault}. Nothing was restarted")
        check_gangs(state, [one.spec for one in own], owner, starting, may_join=True)
        check_number(state, len(own), owner, is_operator=own[0].by_operator)
    check_quota(state, (one.spec for one in ended if one.principal == event.by.name), event.by)
    outcomes = Counter(_restart(state, process, now, event.by) for process in processes)
    message = "; ".join(f"{count(number)} {outcome}" for outcome, number in outcomes.items())
    state.emit(Reply(event.request, message=message))


def _restart_fault(state: MasterState, process: Process) -> str:
    if process.phase in WAITING and process.forbidden_hosts:
        return ""  # the restart allows these hosts again
    if process.phase is ProcessPhase.SET_ASIDE:
        return f"{process.name} is set aside: {process.reason}"
    if process.phase in WAITING:
        return f"{process.name} waits in the queue already"
    if process.name in state.migrations:
        return why_busy(state.migrations[process.name])
    if process.is_at_rest or process.image is not None:
        return _why_not_desired(state, process) or still_stopping(state, process.name)
    if process.wanted is not DesiredState.RUN:
        return f"{process.name} is being stopped"
    if process.phase is ProcessPhase.UNREACHABLE:
        return f"{process.name} is out of reach: {process.reason}"
    return ""


def _why_not_desired(state: MasterState, process: Process) -> str:
    """Return why a process that has ended is none of its application any more; "" if it is."""
    application = state.applications.get(process.spec.application)
    if application is None or process.name in application.specs:
        return ""
    name = application.name
    if not application.wanted:
        return f"{process.name} is of {name}, which is cancelled: `rosrm revert {name}` starts it"
    version = f"version {application.wanted} of {name}"
    return f"{process.name} is not in {version}: apply a version that has it"


def _restart(state: MasterState, process: Process, now: float, by: Requester) -> str:
    """Begin the restart of a process; return what happens to it."""
    state.record(
        now, EventKind.RESTART_REQUESTED, f"a restart of {process.name} was requested",
        process=process.name, by=by,
    )  # fmt: skip
    outcome = "queued again"
    if process.is_at_rest or process.image is not None:
        queue_again(state, process, now)
    elif process.phase in WAITING:
        state.unqueue(process)
        allow_every_host(process)
        state.enqueue(process, now)
    elif (owner := state.instances[process.owner]).state not in (None, InstanceState.HELD):
        restarts.begin(state, process, owner, now)
        outcome = "being restarted"
    else:
        # An instance that has not started yet starts without this order. An order to restart that
        # arrives before the assignment would prevent the start for good.
        outcome = "not started yet"
    state.save(process)
    return outcome


# --- migrate, cordon, drain -------------------------------------------------------------------


def migration_requested(state: MasterState, event: happened.MigrationRequested, now: float) -> None:
    """Begin the migration of a process."""
    (process,) = known_processes(state, [event.name], event.by)
    host = None if event.host is None else known_host(state, event.host)
    check_rights(running_with(state, process), event.by)
    rejected = try_move(state, process, _cause(event.by), now, host=host, asked=True)
    if rejected is not None:
        _note_refused_move(state, process, rejected.reason, now)
        raise RequestRefused(rejected.reason)
    name = state.migrations[process.name].destination_host.name
    state.emit(Reply(event.request, message=f"{process.name} moves to {name}", host=name))


def _note_refused_move(state: MasterState, process: Process, reason: str, now: float) -> None:
    """Record why a process was not moved, unless that is the newest record of it already."""
    message = f"{process.name} is not moved: {reason}"
    if not process.history or process.history[-1][2] != message:
        state.record(now, EventKind.MIGRATION_REFUSED, message, process=process.name)


def checkpoint_requested(
    state: MasterState, event: happened.CheckpointRequested, now: float
) -> None:
    """Begin to dump a process into an image."""
    _begin(state, event, image_requests.begin_checkpoint, now)


def restore_requested(state: MasterState, event: happened.RestoreRequested, now: float) -> None:
    """Begin to restore a process from its image."""
    _begin(state, event, image_requests.begin_restore, now)


def _begin(
    state: MasterState,
    event: happened.CheckpointRequested | happened.RestoreRequested,
    begin: Callable[[MasterState, Process, str, float], Rejected | None],
    now: float,
) -> None:
    (process,) = known_processes(state, [event.name], event.by)
    rejected = begin(state, process, _cause(event.by), now)
    if rejected is not None:
        raise RequestRefused(rejected.reason)
    migration = state.migrations[event.name]
    message = f"{event.name}: {migration.progress_text}"
    state.emit(Reply(event.request, message=message, host=migration.source_host.name))


def _cause(by: Requester) -> str:
    """Return the cause of a client's change, for records."""
    return f"requested by {by.name}" if by.name else "requested"


def known_host(state: MasterState, name: str) -> Host:
    """Return the host of a name; refuse the request for a name that is not listed."""
    host = state.hosts.by_name.get(name)
    if host is None or host.pruned:
        there = sorted(host.name for host in state.hosts.listed())
        raise RequestRefused(no_such("host", [name], there), "unknown")
    return host


def host_state_requested(
    state: MasterState, event: happened.HostStateRequested, now: float
) -> None:
    """Cordon, uncordon or drain a host."""
    host = known_host(state, event.host)
    kind = _HOST_EVENTS.get(event.action)
    if kind is None:
        fault = f"unknown action {event.action!r}; there are: {', '.join(_HOST_EVENTS)}"
        raise RequestRefused(fault)
    state.hosts.set_closed(
        host, cordoned=event.action != "uncordon", draining=event.action == "drain"
    )
    host.recorded_at.clear()
    host.blocked.clear()
    save_host(state, host)
    done = kind.removeprefix("host_")
    state.record(now, kind, f"{host.name} is {done}", host=host.name, by=event.by)
    reconsider_set_aside(state, now)
    details = f": {departures(state, host, now)}" if host.draining else ""
    state.emit(Reply(event.request, message=f"{host.name} is {done}{details}"))


def rebalance_requested(state: MasterState, event: happened.RebalanceRequested, now: float) -> None:
    """Begin one round of moves that even out the load of the hosts, or reply with its plan."""
    if state.rebalancing.pending:
        names = listed([name for name, _ in state.rebalancing.pending])
        raise RequestRefused(f"a round is under way: {names} will move yet")
    planned = plan_round(state, now)
    if planned.shifts and not event.plan_only:
        begin_round(state, planned, now)
    state.emit(Reply(event.request, message=str(planned)))
