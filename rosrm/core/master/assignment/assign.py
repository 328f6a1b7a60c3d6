"""Assignment of queued processes to the fitting host with the largest margin."""

from __future__ import annotations

from collections.abc import Hashable, Iterator, Mapping, Sequence
from collections.abc import Set as AbstractSet
from dataclasses import replace
from functools import reduce
from math import inf
from typing import Any, Final

import numpy as np

from rosrm.core.master.assignment import gangs
from rosrm.core.master.assignment.demands import demand_of, ranking_of
from rosrm.core.master.assignment.flows import joined, traffic_of
from rosrm.core.master.assignment.gang_search import Blocked, find_places
from rosrm.core.master.assignment.neighbours import (
    awaited_neighbour,
    neighbours_of,
    waiting_with,
)
from rosrm.core.master.assignment.places import (
    array_without_place,
    reserve_places,
    why_no_place,
)
from rosrm.core.master.checkpoint.replication import awaits_states, described, newest_snapshot
from rosrm.core.master.commands import Assign
from rosrm.core.master.dependants import note_restart
from rosrm.core.master.hosts import capabilities
from rosrm.core.master.master_state import MasterState
from rosrm.core.master.recovery.journal_gap import why_no_work
from rosrm.core.master.rescheduling import failures
from rosrm.core.master.scheduling.decision import Decision, decide
from rosrm.core.master.scheduling.feasibility import (
    a_known_host_may,
    refused_everywhere,
    why_all_away,
    why_never,
    why_no_devices,
)
from rosrm.core.master.scheduling.ranking import Ranking
from rosrm.core.master.state.demand import Demand
from rosrm.core.master.state.hosts import HostCondition
from rosrm.core.master.state.process import Process, ProcessPhase
from rosrm.model.event_kinds import EventKind
from rosrm.model.orders import StartInstance
from rosrm.model.values import EMPTY, Assignment
from rosrm.wording import counted, listed

_AWAY: Final = (HostCondition.EXPECTED, HostCondition.LOST, HostCondition.DETACHED)
_AWAITS_SNAPSHOT: Final = "a host that may have its snapshot has not rejoined yet"
#: Longest time, in seconds, for which placement waits for a registered host's first request.
_FIRST_REQUEST: Final = 1.0


def demand_to_move(
    state: MasterState, process: Process, seen: Mapping[str, float], source: str, headroom: float,
    avoided: Mapping[str, str] = EMPTY, *, together: AbstractSet[str] = frozenset(),
) -> Demand:  # fmt: skip
    """Return the demand of a running process at the destination of its migration.

    Args:
        avoided: further hosts that must not be chosen, each with the reason.
        together: names of the processes that move with it to the same host.
    """
    excluded = {
        **process.forbidden_hosts, **unable(state, process, source), **avoided,
        source: "it is the source of the move",
    }  # fmt: skip
    amounts, guessed = demand_amounts(state, process, measured_need(state, seen))
    return Demand(
        process.spec, amounts, guessed, excluded, headroom,
        neighbours=neighbours_of(state, process, together=together),
        traffic=traffic_of(state, process, together=together), plugins=state.placement,
    )  # fmt: skip


def measured_need(state: MasterState, seen: Mapping[str, float]) -> Mapping[str, float]:
    """Return the measured usage that counts at the destination of a move: all of it, or none."""
    return seen if state.settings.need == "measured" else EMPTY


def demand_to_restore(state: MasterState, process: Process, seen: Mapping[str, float]) -> Demand:
    """Return the demand of a process on the host of its image, where it is to be restored."""
    return Demand(
        process.spec, *demand_amounts(state, process, seen),
        neighbours=neighbours_of(state, process), traffic=traffic_of(state, process),
        plugins=state.placement,
    )  # fmt: skip


def demand_amounts(
    state: MasterState, process: Process, seen: Mapping[str, float]
) -> tuple[Mapping[str, float], frozenset[str]]:
    """Return the amount of each resource that a process needs, and the estimated resources.

    A measured amount (`seen`) is not an estimate.
    """
    needs = state.estimate(process.spec)
    names = {**needs.amounts, **seen}
    amounts = {name: max(needs.amounts.get(name, 0.0), seen.get(name, 0.0)) for name in names}
    guessed = {name for name in needs.estimated if amounts[name] > seen.get(name, 0.0)}
    return amounts, frozenset(guessed)


def joint_demand(state: MasterState, demands: Mapping[str, Demand]) -> Demand:
    """Return the demand of the first process for a host that takes all of the processes.

    `demands`: the demand of each process by its name.
    """
    (_, demand), *others = demands.items()
    if not others:
        return demand
    table, excluded = state.hosts, dict(demand.excluded)
    for name, other in others:
        ranking = ranking_of(state, other)
        for host in table.listed():
            if not ranking.fits(host.column):
                excluded.setdefault(host.name, f"it cannot take {name}, which must run beside it")
    for column in np.flatnonzero(table.bound - table.processes < len(demands)):
        why = f"it accepts no {counted(len(demands), 'more process', 'more processes')} now"
        excluded.setdefault(table.hosts[column].name, why)
    amounts: dict[str, float] = {}
    devices = tuple(need for one in demands.values() for need in one.spec.devices)
    for one in demands.values():
        for resource, amount in one.amounts.items():
            amounts[resource] = amounts.get(resource, 0.0) + amount
    declared = frozenset[str]().union(*(one.declared for one in demands.values()))
    return replace(
        demand, amounts=amounts, estimated=frozenset(amounts) - declared, excluded=excluded,
        spec=replace(demand.spec, devices=devices),
        traffic=reduce(joined, (one.traffic for one in demands.values())),
    )  # fmt: skip


def unable(state: MasterState, process: Process, source: str) -> dict[str, str]:
    """Return the hosts to which the strategy cannot move the process, each with the reason."""
    strategy = process.spec.migration.strategy or ""
    if not capabilities.are_checked(state, strategy):
        return {}
    here = state.hosts.by_name[source]
    faults = {
        host.name: capabilities.fault(state, strategy, here, host) for host in state.hosts.hosts
    }
    return {name: fault for name, fault in faults.items() if fault}


def decide_now(state: MasterState, process: Process) -> Decision:
    """Return the decision that placement would make now about a waiting process."""
    return decide(ranking_of(state, demand_of(state, process)))


def place_waiting(state: MasterState, now: float) -> None:
    """Assign queued processes until the head fits nowhere (`backfill`: until no process fits).

    A head that its owner may not place before those of others holds back its owner's alone.
    """
    if not len(state.queue) or state.placed_at == _versions(state):
        return
    head = state.queue.head()
    if head is None:
        return
    why = why_no_work(state, now)
    if why:
        state.processes[head].reason = why
        return
    why = first_request_awaited(state, now)
    if why:
        state.processes[head].reason = state.processes[head].reason or why
        return
    timed = _passed_over(state, now)
    passed_over = timed | state.queue.awaiting
    if state.neighbours.declared:
        _place_with_neighbours(state, passed_over, now)
    else:
        _place(state, passed_over, now)
    if not timed:  # the others wait for an event
        state.placed_at = _versions(state)


def held_back(state: MasterState, now: float) -> frozenset[str]:
    """Return the processes in the queue that wait for something other than room, with their gangs.

    No process may be stopped to make room for them.
    """
    neighbours = _awaiting_neighbours(state, now)
    waiting = _passed_over(state, now) | state.queue.awaiting | neighbours
    return _with_gangs(state, waiting, now).union(_without_places(state))


def _place(state: MasterState, passed_over: frozenset[str], now: float) -> None:
    passed_over = _with_gangs(state, passed_over, now)
    if state.settings.backfill:
        _place_any(state, passed_over, now)
    else:
        _place_in_order(state, passed_over, now)


def _place_with_neighbours(state: MasterState, passed_over: frozenset[str], now: float) -> None:
    """Place processes; then those that waited for one of them, until all others still wait."""
    awaiting: frozenset[str] | None = None
    while awaiting != (found := _awaiting_neighbours(state, now)):
        awaiting = found
        _place(state, passed_over | awaiting, now)


def first_request_awaited(state: MasterState, now: float) -> str:
    """Return why placement waits for recently registered hosts; "" if it does not wait.

    Without the wait, the host with the first request would get every process that was submitted
    while the hosts registered. Hosts that register later do not prolong the wait.
    """
    awaited = state.hosts.about_to_ask(now - _FIRST_REQUEST)
    if not len(awaited):
        state.held_since = inf
        return ""
    state.held_since = min(state.held_since, now)
    if now - state.held_since >= _FIRST_REQUEST:
        return ""
    names = listed((state.hosts.hosts[column].name for column in awaited), most=3)
    return f"waits for the first request for work of {names}, registered just now"


def _passed_over(state: MasterState, now: float) -> frozenset[str]:
    """Return the processes that wait for a time or snapshot, and do not block those behind them."""
    delayed = _delayed(state, now)
    if not state.hosts.any_having(_AWAY):
        return delayed
    names = [
        name for name in state.queue
        if name not in state.queue.awaiting and awaits_states(state, state.processes[name], now)
    ]  # fmt: skip
    for name in names:
        _record_wait_reason(state, state.processes[name], _AWAITS_SNAPSHOT, now)
    return delayed.union(names)


def _with_gangs(state: MasterState, waiting: frozenset[str], now: float) -> frozenset[str]:
    """Return processes that wait for something else than room, with all of their gangs."""
    if not state.gangs.members:
        return waiting
    others = gangs.incomplete(state, waiting)
    for name, why in others.items():
        _record_wait_reason(state, state.processes[name], why, now)
    return waiting.union(others)


def _delayed(state: MasterState, now: float) -> frozenset[str]:
    """Return the processes that wait for the end of their delay."""
    for name in list(state.queue.delayed):
        process = state.processes[name]
        if now >= process.placed_from:
            state.queue.delayed.remove(name)
            continue
        if name in state.queue.awaiting:
            continue  # its reason names what it awaits
        why = f"it is placed on another host after {process.queue_delay:g} s"
        _record_wait_reason(state, process, why, now)
    return frozenset(state.queue.delayed)


def _awaiting_neighbours(state: MasterState, now: float) -> frozenset[str]:
    """Return the processes that wait for a neighbour and do not block those behind them."""
    found = []
    for name in state.neighbours.declared:
        if name in state.queue and name not in state.queue.awaiting:
            why = awaited_neighbour(state, state.processes[name])
            if why:
                _record_wait_reason(state, state.processes[name], why, now)
                found.append(name)
    return frozenset(found)


def _without_places(state: MasterState) -> Iterator[str]:
    """Yield the queued processes for which, or for whose gang, an array has no free place."""
    if state.queue.has_bounds:
        for name in state.queue:
            if array_without_place(state, state.processes[name]) is not None:
                yield name


def _place_in_order(state: MasterState, passed_over: frozenset[str], now: float) -> None:
    for process in _in_turn(state, passed_over, now):
        if not _place_or_set_aside(state, process, now):
            _place_past(state, process, passed_over, now)
            return


def _place_past(
    state: MasterState, blocking: Process, passed_over: frozenset[str], now: float
) -> None:
    """Place processes behind one that waits for room, of owners whom it may not hold back."""
    owners = {blocking.principal}
    if blocking.by_operator:
        return
    for process in _in_turn(state, passed_over, now):
        if process.principal not in owners and not _place_or_set_aside(state, process, now):
            if process.by_operator:
                return
            owners.add(process.principal)


def _in_turn(state: MasterState, passed_over: frozenset[str], now: float) -> Iterator[Process]:
    """Yield, in order, the queued processes that wait only for a host.

    Without backfill, a gang that waits for places of an array holds back the jobs behind it in the
    array, because otherwise it might never get all of its places.
    """
    processes, has_bounds = state.processes, state.queue.has_bounds
    state.queue.arrays.reserved.clear()
    for name in state.queue.in_turn():
        if name in passed_over:
            continue
        process = processes[name]
        if not has_bounds or array_without_place(state, process) is None:
            yield process
        elif process.awaits_gang:
            _record_wait_reason(state, process, why_no_place(state, process), now)
            if not state.settings.backfill:
                reserve_places(state, process)


def _versions(state: MasterState) -> tuple[int, ...]:
    """Return the version counters of all inputs of placement.

    While none of them grows, a process that did not fit still does not fit.
    """
    hosts, queue, gangs_, learned = state.hosts, state.queue, state.gangs, state.learned
    return hosts.version, len(hosts.touched), queue.version, gangs_.version, learned.version


def _place_any(state: MasterState, passed_over: frozenset[str], now: float) -> None:
    fit_nowhere = set[Hashable]()
    for process in _in_turn(state, passed_over, now):
        key = process.gang or demand_of(state, process).key
        if key not in fit_nowhere and not _place_or_set_aside(state, process, now):
            fit_nowhere.add(key)


def _place_or_set_aside(state: MasterState, process: Process, now: float) -> bool:
    """Place a process, or set it aside; return False if it keeps waiting and blocks the queue.

    The others of its gang share its fate.
    """
    members = gangs.members_of(state, process)
    if len(members) > 1:
        return _place_gang(state, members, now)
    demand = demand_of(state, process)
    ranking = ranking_of(state, demand)
    column = ranking.best()
    if column >= 0:
        tied = waiting_with(state, process) if state.neighbours.declared else ()
        decision = _decide_jointly(state, process, ranking, tied) if tied else None
        decision = decision or decide(ranking, chosen=column)
        _assign(state, process, ranking, decision, now)
        return True
    never = why_never(state.hosts, demand)
    if never:
        _set_aside(state, process, never, now)
        return True
    _record_waiting(state, process, demand, now)
    return False


def _place_gang(state: MasterState, members: Sequence[Process], now: float) -> bool:
    """Place all processes of a gang, or none; otherwise as `_place_or_set_aside`."""
    found = find_places(state, members)
    if not isinstance(found, Blocked):
        for process, column in found:
            ranking = ranking_of(state, demand_of(state, process))
            _assign(state, process, ranking, decide(ranking, chosen=column), now)
        return True
    never = gangs.why_gang_never(state, members, now)
    if never:
        why = f"no hosts may take {gangs.size_of(members)}: {never}"
        for process in members:
            state.queue.remove(process.name)
            _wait_aside(state, process, why, now)
    else:
        _record_waiting_gang(state, members, found, now)
    return bool(never)


def _decide_jointly(
    state: MasterState, process: Process, ranking: Ranking, tied: Sequence[Process]
) -> Decision | None:
    """Return the decision for a host with room for all tied processes; None: there is none."""
    names = {process.name, *(one.name for one in tied)}
    demands = {process.name: ranking.demand}
    for one in tied:
        demands[one.name] = replace(
            demand_of(state, one), neighbours=neighbours_of(state, one, together=names),
            traffic=traffic_of(state, one, together=names),
        )  # fmt: skip
    joint = ranking_of(state, joint_demand(state, demands))
    return decide(joint) if joint.best() >= 0 else None


def _assign(
    state: MasterState, process: Process, ranking: Ranking, decision: Decision, now: float
) -> None:
    assignment = _take_place(state, process, ranking, decision, now)
    host = state.hosts.hosts[decision.column]
    state.emit(Assign(host.host_id, assignment))


def _take_place(
    state: MasterState, process: Process, ranking: Ranking, decision: Decision, now: float
) -> Assignment:
    """Give a queued process the place of a decision, and return its assignment."""
    column = decision.column
    host = state.hosts.hosts[column]
    instance = state.new_instance_id(process)
    state.queue.remove(process.name)
    state.reserve(instance, process.spec, host, now, ranking)
    ranking.note_assignment()
    process.owner, process.left_behind, process.exit_code = instance.number, None, None
    process.queue_delay = 0.0
    state.set_phase(process, ProcessPhase.ASSIGNED, now)
    state.note_decision(process, decision, "assigned", now)
    devices = [str(one) for one in state.instances[instance.number].devices]
    with_them = f" with {listed(devices)}" if devices else ""
    assignment = state.assignment(instance, process.spec)
    snapshot = newest_snapshot(state, assignment, now)
    state.record(
        now, EventKind.ASSIGNED,
        f"{process.name} is assigned to {host.name}{with_them}{described(snapshot)}",
        process=process.name, host=host.name,
        facts={
            "number": instance.number, "decision": process.decision, "devices": devices,
            **({"snapshot": snapshot} if snapshot else {}),
        },
    )  # fmt: skip
    state.save(process)
    note_restart(state, process)
    return assignment


def assign_to_adopt(state: MasterState, process: Process, now: float) -> None:
    """Assign a process that runs already to its host, also if that has no room and asks for none.

    So it is ordered, not kept for the next request of the host.
    """
    host = state.hosts.by_name[process.spec.adoption.host]
    ranking = ranking_of(state, demand_of(state, process))
    decision = decide(ranking, chosen=host.column)
    state.send(host, StartInstance(_take_place(state, process, ranking, decision, now)))


def _set_aside(state: MasterState, process: Process, reason: str, now: float) -> None:
    state.unqueue(process)
    if refused_everywhere(state.hosts, demand_of(state, process)):
        why = f"no host can start it: {reason}"
        state.set_phase(process, ProcessPhase.FAILED, now, why)
        process.ended_on = next(reversed(process.failed_on), "")  # of its last run, with its logs
        state.note_decision(process, decide_now(state, process), "set_aside", now)
        state.record(now, EventKind.FAILED, f"{process.name} failed: {why}", process=process.name)
    else:
        _wait_aside(state, process, _why_aside(reason), now)
    state.save(process)


def _wait_aside(state: MasterState, process: Process, why: str, now: float) -> None:
    state.set_phase(process, ProcessPhase.SET_ASIDE, now, why)
    state.set_aside.add(process.name)
    state.record(
        now, EventKind.SET_ASIDE, f"{process.name} is set aside: {why}", process=process.name
    )
    state.save(process)


def _why_aside(reason: str) -> str:
    return f"no host may take it: {reason}"


def _keep_aside(state: MasterState, process: Process, why: str, now: float) -> None:
    """Replace the reason of a process that is set aside, if the reason has changed."""
    if process.reason != why:
        state.set_phase(process, ProcessPhase.SET_ASIDE, now, why)
        state.save(process)


def reconsider_set_aside(state: MasterState, now: float) -> None:
    """Requeue in order every process that a host may take now; update the reasons of the others.

    While the limits of the hosts are unknown, a process keeps its place and its reason.
    """
    if not state.set_aside:
        return
    judged: dict[object, tuple[str, bool]] = {}
    aside = [state.processes[name] for name in state.set_aside]
    for process in sorted(aside, key=lambda one: one.order):
        key = process.gang or demand_of(state, process).key
        if key not in judged:
            judged[key] = _judged(state, process, now)
        never, may_be_placed = judged[key]
        if never:
            _keep_aside(state, process, never, now)
        elif may_be_placed:
            _return_from_aside(state, process, now)


def _judged(state: MasterState, process: Process, now: float) -> tuple[str, bool]:
    """Return why no hosts may take a process and its gang ("": some may), and if known ones may."""
    members = gangs.members_of(state, process)
    if len(members) > 1:
        never = gangs.why_gang_never(state, members, now)
        why = never and f"no hosts may take {gangs.size_of(members)}: {never}"
        return why, gangs.known_hosts_may(state, members)
    demand = demand_of(state, process)
    never = why_never(state.hosts, demand)
    return never and _why_aside(never), a_known_host_may(state.hosts, demand)


def _return_from_aside(state: MasterState, process: Process, now: float) -> None:
    state.set_aside.discard(process.name)
    state.enqueue(process, now)
    state.record(
        now, EventKind.QUEUED, f"{process.name} returns to the queue: a host may take it now",
        process=process.name,
    )  # fmt: skip
    state.save(process)


def _record_waiting(state: MasterState, process: Process, demand: Demand, now: float) -> None:
    """Record once that the head of the queue waits, and the reason."""
    if not state.hosts.listed():
        _record_wait_reason(state, process, "no host has registered yet", now)
        return
    room = state.preemption.room_made.get(process.name)
    made = room.reason if room is not None and room.host is not None else ""
    reason = why_all_away(state.hosts, demand) or made or _why_waiting(state, process)
    if process.reason != reason:
        state.note_decision(process, decide_now(state, process), "waits", now)
        _record_wait_reason(state, process, reason, now, {"decision": process.decision})


def _record_waiting_gang(
    state: MasterState, members: Sequence[Process], blocked: Blocked, now: float
) -> None:
    """Record once that a gang at the head of the queue waits, and the reason."""
    first, one = members[0], blocked.process
    reason = why_all_away(state.hosts, demand_of(state, one)) or gangs.why_blocked(members, blocked)
    if not state.hosts.listed():
        reason = "no host has registered yet"
    if first.reason != reason:
        state.note_decision(one, decide_now(state, one), "waits", now)
        _record_wait_reason(state, first, reason, now, {"decision": one.decision})
    for process in members:
        process.reason = reason


def _why_waiting(state: MasterState, process: Process) -> str:
    failed = failures(process)
    no_host = f"it failed on {failed}, and no other host can" if failed else "no host can"
    devices = why_no_devices(state.hosts, process.spec.devices)
    return f"{no_host} take it now" + (f": {devices}" if devices else "")


def _record_wait_reason(
    state: MasterState, process: Process, reason: str, now: float,
    facts: Mapping[str, Any] = EMPTY,
) -> None:  # fmt: skip
    """Record the reason for which a process waits, once per reason."""
    if process.reason != reason:
        process.reason = reason
        message = f"{process.name} waits: {reason}"
        state.record(now, EventKind.WAITS, message, process=process.name, facts=facts)
