"""Gangs: processes of one submission that are placed in one decision, or wait together.

============================  ==================================================================
event                         effect on the gang
============================  ==================================================================
submission, restart           the process awaits its gang: it is placed with the others that do
assignment                    all processes of the gang are assigned in the same step
start, or its host is lost    the process leaves the gang, and is placed alone from now on
return to the queue           before its start: the assigned processes of the gang that have not
                              started either are stopped, and wait with it again
cancellation                  the process leaves the gang, and the others do not wait for it
============================  ==================================================================
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from collections.abc import Set as AbstractSet
from dataclasses import replace
from math import inf
from typing import Final

from rosrm.core.master import lifecycle
from rosrm.core.master.assignment.demands import demand_of
from rosrm.core.master.assignment.gang_search import MOST_MEMBERS, Blocked, find_places_if_empty
from rosrm.core.master.assignment.neighbours import neighbours_of
from rosrm.core.master.dependants import orders_from, pending_specs
from rosrm.core.master.master_state import MasterState
from rosrm.core.master.outcomes import RequestRefused
from rosrm.core.master.scheduling.feasibility import a_known_host_may, why_never
from rosrm.core.master.state.demand import Demand
from rosrm.core.master.state.process import DesiredState, GangKey, Process, ProcessPhase
from rosrm.model.event_kinds import EventKind
from rosrm.model.gang_rules import gang_array_fault, gang_order_fault
from rosrm.model.values import ProcessSpec
from rosrm.wording import listed, standing

#: Seconds for which the answer of a search stands, because a gang may wait for long.
_JUDGED_FOR: Final = 1.0


def check_gangs(
    state: MasterState, specs: Sequence[ProcessSpec], principal: str,
    requested: Sequence[ProcessSpec], *, may_join: bool = False,
) -> None:  # fmt: skip
    """Refuse processes whose gang cannot start, or has the name of one that has not started.

    Args:
        state: has the gangs that wait.
        specs: processes of one owner that start.
        principal: the owner.
        requested: all processes of the request, whose start orders may have changed.
        may_join: the processes join a gang of that name.
    """
    for name in dict.fromkeys(spec.together for spec in specs if spec.together):
        waiting = state.gangs.members.get((principal, name), ())
        many = len({spec.name for spec in specs if spec.together == name}.union(waiting))
        if many > MOST_MEMBERS:
            raise RequestRefused(
                f"the gang {name} has {many} processes; at most {MOST_MEMBERS} start together. "
                f"Nothing was queued"
            )
        if waiting and not may_join:
            raise RequestRefused(
                f"a gang {name} waits already, and {listed(waiting)} of it "
                f"{'has' if len(waiting) == 1 else 'have'} not started: cancel it, or choose "
                f"another name for `together`. Nothing was queued",
                "name_taken",
            )
    gang_of = {spec.name: (principal, spec.together) for spec in specs if spec.together}
    fault = gang_fault(state, requested, gang_of)
    if fault:
        raise RequestRefused(f"{fault}. Nothing was queued")


def gang_fault(
    state: MasterState, coming: Sequence[ProcessSpec], joining: Mapping[str, GangKey],
    leaving: AbstractSet[str] = frozenset(),
) -> str:  # fmt: skip
    """Return why a gang could never start once specs are in force; "": each may.

    Args:
        state: has the processes and gangs that wait, and those that applications start later.
        coming: specs that come into force, by a request or by a return; without a circle.
        joining: those of the processes that start with their gang.
        leaving: names of processes that are cancelled.
    """
    given, planned = {spec.name: spec for spec in coming}, pending_specs(state)
    pending = {
        name: (state.applications[spec.application].principal, spec.together)
        for name, spec in planned.items()
        if spec.together and name not in given and _starts_again(state, name)
    }
    waiting = {
        name: gang
        for gang, names in state.gangs.members.items()
        for name in names
        if gang is not None and (name not in given or given[name].together == gang[1])
    }
    known = {**pending, **waiting, **joining}
    gang_of = {name: gang for name, gang in known.items() if name not in leaving}
    if not gang_of:
        return ""
    members: dict[GangKey, list[str]] = {}
    for name, gang in gang_of.items():
        members.setdefault(gang, []).append(name)
    mates = {name: members[gang] for name, gang in gang_of.items()}
    joined = set(joining.values())
    changed = {name: gang for name, gang in gang_of.items() if gang in joined}
    specs = {
        name: given.get(name) or planned.get(name) or state.processes[name].spec
        for name in changed
    }  # fmt: skip
    fault = gang_array_fault(changed, specs)
    fault = fault or gang_order_fault(gang_of, orders_from(state, coming, mates))
    return f"{fault.process}: {fault.text}" if fault is not None else ""


def _starts_again(state: MasterState, name: str) -> bool:
    """Return True if a desired process does not live, so that it joins its gang when it starts."""
    process = state.processes.get(name)
    if process is None or process.phase.is_terminal:
        return True
    return process.wanted is DesiredState.CANCEL


def members_of(state: MasterState, process: Process) -> list[Process]:
    """Return the processes together with which a process is placed, in order of submission."""
    if not process.awaits_gang:
        return [process]
    found = (state.processes[name] for name in state.gangs.of(process))
    return sorted(found, key=lambda one: (-one.spec.priority, one.order))


def size_of(members: Sequence[Process]) -> str:
    """Return a phrase for all processes of a gang."""
    return f"all {len(members)} of the gang {members[0].spec.together}"


def incomplete(state: MasterState, passed_over: frozenset[str]) -> dict[str, str]:
    """Return each queued process whose gang cannot be placed yet, with the reason.

    `passed_over`: processes that wait for something else than room.
    """
    found: dict[str, str] = {}
    for names in state.gangs.members.values():
        absent = [name for name in names if name not in state.queue]
        held = [name for name in names if name in passed_over]
        if not absent and not held:
            continue
        for name in names:
            if name in state.queue and name not in passed_over:
                found[name] = _why_incomplete(state, absent, held)
    return found


def _why_incomplete(state: MasterState, absent: Sequence[str], held: Sequence[str]) -> str:
    name = (absent or held)[0]
    other = state.processes[name]
    gang = f"{name} of its gang {other.spec.together}"
    if not absent:
        return f"{gang} waits: {other.reason}"
    return f"{gang} {standing(other.phase.value)}"


def why_gang_never(state: MasterState, members: Sequence[Process], now: float) -> str:
    """Return why no hosts may take all of a gang before a lasting change; "" if some may."""
    table = state.hosts
    for process in members:
        never = why_never(table, _demand_without_mates(state, process, members))
        if never:
            return f"{process.name}: {never}"
    return _why_never_together(state, members, now) if table.listed() else ""


def _why_never_together(state: MasterState, members: Sequence[Process], now: float) -> str:
    """Return why a gang does not fit even on empty hosts; the answer stands for a second."""
    names = tuple(process.name for process in members)
    at, why = state.gangs.judged.get(names, (-inf, ""))
    if now - at >= _JUDGED_FOR:
        found = find_places_if_empty(state, members)
        why = ""
        if isinstance(found, Blocked) and found.certain:
            name = found.process.name
            why = f"{name} fits on no host beside the others, even if nothing else runs"
        state.gangs.judged[names] = now, why
    return why


def known_hosts_may(state: MasterState, members: Sequence[Process]) -> bool:
    """Return True if for each process there is a host with known limits that may take it."""
    return all(
        a_known_host_may(state.hosts, _demand_without_mates(state, process, members))
        for process in members
    )


def _demand_without_mates(
    state: MasterState, process: Process, members: Sequence[Process]
) -> Demand:
    """Return the demand of a process without its rules "near" others of its gang."""
    demand = demand_of(state, process)
    if not process.spec.neighbours:
        return demand
    names = {one.name for one in members}
    return replace(demand, neighbours=neighbours_of(state, process, together=names))


def recall_gangs(state: MasterState, now: float) -> None:
    """Stop the assigned processes of each gang of which one has returned to the queue."""
    returned, state.gangs.returned = state.gangs.returned, {}
    for gang in returned:
        names = list(state.gangs.members.get(gang, ()))
        waiting = [name for name in names if name in state.queue]
        for name in names:
            process = state.processes[name]
            if waiting and process.phase is ProcessPhase.ASSIGNED and process.owner:
                _recall(state, process, waiting[0], now)


def _recall(state: MasterState, process: Process, other: str, now: float) -> None:
    if process.wanted is not DesiredState.RUN or process.name in state.migrations:
        return
    owner = state.instances[process.owner]
    why = f"{other} of its gang {process.spec.together} has returned to the queue"
    process.wanted = DesiredState.REQUEUE
    state.set_phase(process, ProcessPhase.STOPPING, now, why)
    state.record(
        now, EventKind.STOPPING, f"{process.name} is stopped before its start: {why}",
        process=process.name, host=owner.host.name,
    )  # fmt: skip
    lifecycle.stop_instance(state, owner, now)
    state.save(process)


def why_blocked(members: Sequence[Process], blocked: Blocked) -> str:
    """Return why a gang waits for room."""
    beside = " beside the others" if blocked.beside else ""
    where = f"{blocked.process.name} fits on no host{beside} now"
    return f"no room for {size_of(members)} at once: {where}"
