"""Start order: waiting processes start after their dependencies; stops are in the reverse order.

=============================  ====================================================================
process                        action, when a dependency or a dependant of it has changed
=============================  ====================================================================
in the queue                   may be placed once all conditions hold, the delay is over and the
                               capabilities of its strategy are known; until then it blocks no other
                               process, and its reason names what it awaits
running, `on_restart`          is restarted in place once all conditions hold again, if a dependency
                               was started or restarted after it
cancelled, with dependants     is ordered to stop once its cancelled dependants have ended
=============================  ====================================================================

The conditions count at each start from the queue, but not at restarts by the policy of the process,
nor in a migration. Nothing is journaled but specs, phases, desired states and `restart_due`.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from math import inf
from typing import Final

from rosrm.core.master import lifecycle, restarts
from rosrm.core.master.dependants import (
    awaited_ends,
    circle_from,
    pending_specs,
    waits_for_ends,
)
from rosrm.core.master.master_state import MasterState
from rosrm.core.master.state.process import DesiredState, Process, ProcessPhase
from rosrm.extensions.declared_fields import UnknownCapabilities
from rosrm.model.dependencies import circle_in, condition_fault
from rosrm.model.description_checks import other_process_fault
from rosrm.model.event_kinds import EventKind
from rosrm.model.values import InstanceState, Kind, ProcessSpec, StartCondition, StartOrder
from rosrm.wording import listed, no_such, standing

#: Seconds beyond the time-out of the stop of a dependant, after which its end is not awaited.
_PATIENCE: Final = 30.0
#: Seconds until a strategy is asked again for the capabilities that it has not told.
_ASK_EVERY: Final = 1.0
#: Phases of a dependency that it leaves only by a request, or when its host returns.
_NEEDS_HELP: Final = (
    ProcessPhase.SET_ASIDE, ProcessPhase.UNREACHABLE, ProcessPhase.STUCK, ProcessPhase.CHECKPOINTED,
)  # fmt: skip
#: Phases in which a process, and states in which its instance, can be restarted in place.
_RESTARTABLE: Final = (ProcessPhase.STARTING, ProcessPhase.RUNNING, ProcessPhase.BACKOFF)
_STARTED: Final = (InstanceState.RUNNING, InstanceState.READY, InstanceState.BACKOFF)
_TO_BE: Final[Mapping[StartCondition, str]] = {"ready": "to be ready", "finished": "to finish"}


def review(state: MasterState, now: float) -> None:
    """Review the processes of which a dependency or a dependant has changed."""
    for name in state.start_orders.take_due(now):
        process = state.processes.get(name)
        if process is None:
            continue
        if name in state.queue:
            _review_waiting(state, process, now)
        elif name in state.start_orders.last_to_stop:
            _review_stop(state, process, now)
        elif process.restart_due:
            _review_restart(state, process, now)


# --- conditions -------------------------------------------------------------------------------


def _review_waiting(state: MasterState, process: Process, now: float) -> None:
    """Let a queued process wait for its dependencies, or be placed."""
    name = process.name
    reason = (
        _awaited_strays(state, process, now)
        or _awaited(state, process, now)
        or _awaited_capabilities(state, process, now)
    )
    if reason and process.reason != reason:
        state.record(now, EventKind.WAITS, f"{name} {reason}", process=name)
    if reason or name in state.queue.awaiting:
        process.reason = reason
    state.queue.set_awaiting(name, awaiting=bool(reason))


def _awaited_strays(state: MasterState, process: Process, now: float) -> str:
    """Return why a process waits for strays of its name, as a predicate; "": it waits for none.

    The journal may have lost their assignments, so they may run. But a host may also report them
    falsely, so the wait has an end, which no further report delays.
    """
    numbers = state.strays.get(process.name)
    if not numbers:
        return ""
    if not process.strays_until:
        process.strays_until = now + process.spec.stop.timeout + _PATIENCE
    if now >= process.strays_until:
        return ""
    state.start_orders.set_delay(process.name, process.strays_until)
    strays = [state.instances[number] for number in sorted(numbers)]
    have = "has" if len(strays) == 1 else "have"
    return f"waits until {listed(f'{one.id} on {one.host.name}' for one in strays)} {have} ended"


def _awaited_capabilities(state: MasterState, process: Process, now: float) -> str:
    """Return why a process waits until its strategy tells its capabilities; "": it has done so.

    A start without them might be one without the state of the process.
    """
    able = state.declared.capabilities_of(process.spec)
    if not isinstance(able, UnknownCapabilities):
        return ""
    state.start_orders.set_delay(process.name, now + _ASK_EVERY)
    return f"waits: {able.reason}"


def _awaited(state: MasterState, process: Process, now: float) -> str:
    """Return a predicate on what a process awaits before it may start; "": nothing."""
    reason, start = awaited_by(state, process.spec.start_order, now)
    state.start_orders.set_delay(process.name, start if start > now else inf)
    return reason


def awaited_by(state: MasterState, order: StartOrder, now: float) -> tuple[str, float]:
    """Return a predicate on what a start awaits ("": nothing), and its earliest time, or inf."""
    held_since = {name: _holds_since(state, name, what) for name, what in order.after.items()}
    start = max(held_since.values(), default=-inf) + order.delay
    if start <= now:
        return "", start
    if start < inf:
        why = f"waits for the end of its delay of {order.delay:g} s after {listed(order.after)}"
        return why, start
    missing = [name for name, since in held_since.items() if since == inf]
    conditions = listed(f"for {name} {_TO_BE[order.after[name]]}" for name in missing)
    obstacles = [_obstacle(state, name, order.after[name]) for name in missing]
    return "; ".join([f"waits {conditions}", *filter(None, obstacles)]), inf


def _holds_since(state: MasterState, name: str, condition: StartCondition) -> float:
    """Return the time since when a condition holds; inf: it does not."""
    process = state.processes.get(name)
    if process is None:
        return inf
    is_job = process.spec.kind is Kind.JOB
    holds = process.phase is ProcessPhase.FINISHED and (condition == "finished" or is_job)
    holds = holds or (process.phase is ProcessPhase.RUNNING and condition == "ready")
    return process.since if holds else inf


def _obstacle(state: MasterState, name: str, condition: StartCondition) -> str:
    """Return why a condition may never hold without help, and what helps; "": it may."""
    process = state.processes.get(name)
    if process is None:
        return f"{name} does not exist: submit it again"
    if process.wanted is DesiredState.CANCEL and not process.phase.is_terminal:
        return f"{name} is being cancelled"
    if process.phase.is_terminal:
        return f"{name} {standing(process.phase.value)}: `rosrm restart {name}` starts it again"
    fault = condition_fault(process.spec, condition)  # its spec may have changed since the check
    if fault:
        return fault
    return f"{name} {standing(process.phase.value)}" if process.phase in _NEEDS_HELP else ""


# --- restarts ---------------------------------------------------------------------------------


def _review_restart(state: MasterState, process: Process, now: float) -> None:
    """Restart a process in place, unless it does not run or a condition does not hold."""
    owner = state.owner_of(process)
    if owner is None or owner.restarting or process.phase not in _RESTARTABLE:
        return
    if owner.state not in _STARTED:
        return  # an order before the start of the instance would prevent the start
    if process.wanted is not DesiredState.RUN or _awaited(state, process, now):
        return
    state.record(
        now, EventKind.DEPENDENCY_RESTARTED,
        f"{process.name} is restarted on {owner.host.name}, because a process after which it "
        f"starts was restarted",
        process=process.name, host=owner.host.name,
    )  # fmt: skip
    process.restart_due = False
    restarts.begin(state, process, owner, now, follows=True)


# --- stops ------------------------------------------------------------------------------------


def _review_stop(state: MasterState, process: Process, now: float) -> None:
    """Stop a cancelled process if its dependants have ended; else begin its time-out again."""
    orders, owner = state.start_orders, state.owner_of(process)
    if orders.last_to_stop[process.name] == inf:
        orders.last_to_stop[process.name] = now
    if owner is None or process.name in state.migrations:
        return  # it is stopped when its migration has ended
    if not waits_for_ends(state, process, now):
        lifecycle.stop_instance(state, owner, now)
    lifecycle.note_phase(state, process, owner, now)


def review_stops(state: MasterState, now: float) -> None:
    """Stop each cancelled process whose dependants do not end in time."""
    orders = state.start_orders
    ends = {name: awaited_ends(state, state.processes[name]) for name in orders.last_to_stop}
    circle = circle_in(ends)  # of an older journal: each of them waits in turn, without an end
    for name, since in list(orders.last_to_stop.items()):
        process, awaited = state.processes[name], ends[name]
        if name not in circle and not ends.keys().isdisjoint(awaited):
            continue  # one of them waits in turn
        longest = max((state.processes[one].spec.stop.timeout for one in awaited), default=0.0)
        owner = state.owner_of(process)
        if owner is None or now - since < longest + _PATIENCE or name in state.migrations:
            continue
        del orders.last_to_stop[name]
        state.record(
            now, EventKind.DEPENDANTS_LEFT,
            f"{name} is stopped before {listed(awaited)}, which did not end in time",
            process=name, host=owner.host.name,
        )  # fmt: skip
        lifecycle.stop_instance(state, owner, now)
        lifecycle.note_phase(state, process, owner, now)
        orders.note_dependant(process.spec.start_order)


# --- checks of submissions --------------------------------------------------------------------


def start_order_fault(state: MasterState, starting: Sequence[ProcessSpec]) -> str:
    """Return why processes with these start orders must not be queued; "": they may.

    Args:
        state: has the other processes.
        starting: processes that are submitted together, or ended ones that start again together.
    """
    specs = {spec.name: spec for spec in starting if spec.start_order.after}
    if not specs:
        return ""
    known = {spec.name: spec for spec in starting}
    for spec in specs.values():
        for name, condition in spec.start_order.after.items():
            fault = other_process_fault(name, spec.name)
            fault = fault or _dependency_fault(state, known, name, condition)
            if fault:
                return f"{spec.name}: after: {fault}"
    return circle_from(state, starting)


def dependants_fault(state: MasterState, coming: Iterable[ProcessSpec], owner: str) -> str:
    """Return why a process that does not change could never start after a changed one; "": none.

    Args:
        state: has the dependants. Those of other users hold back no change.
        coming: specs that come into force together.
        owner: owner of those among them that do not live.
    """
    known, pending = {spec.name: spec for spec in coming}, pending_specs(state)
    later: dict[str, list[str]] = {}
    for spec in pending.values():
        for name in spec.start_order.after:
            later.setdefault(name, []).append(spec.name)
    for name, spec in known.items():
        fault = condition_fault(spec, "finished")
        others = {*state.start_orders.dependants.get(name, ()), *later.get(name, ())}
        for other in sorted(others - known.keys()) if fault else ():
            order = (pending.get(other) or state.processes[other].spec).start_order
            if order.after.get(name) == "finished" and _binds(state, other, name, owner):
                return (
                    f"{other} starts once {name} has finished, but {fault}. Otherwise cancel "
                    f"{other}, or change its `after`, first"
                )
    return ""


def _binds(state: MasterState, dependant: str, name: str, owner: str) -> bool:
    """Return True if a dependant holds back changes of a process; `owner`: of one that is new."""
    process, other = state.processes.get(dependant), state.processes.get(name)
    if other is not None and not other.phase.is_terminal:
        owner = other.principal
    return process is None or process.by_operator or process.principal == owner


def _dependency_fault(
    state: MasterState, starting: Mapping[str, ProcessSpec], name: str, condition: StartCondition
) -> str:
    """Return why no process can start after this one; "": it can."""
    process, spec = state.processes.get(name), starting.get(name)
    if spec is None and process is not None:
        spec = pending_specs(state).get(name) or state.spec_to_be(process)
    if spec is None:
        return no_such("process", [name], [*starting, *reversed(state.processes)])
    fault = condition_fault(spec, condition)
    if fault:
        return fault
    if name in starting or process is None or _holds_since(state, name, condition) < inf:
        return ""
    ends = process.wanted is DesiredState.CANCEL or process.phase.is_terminal
    return _obstacle(state, name, condition) if ends else ""
