"""Preemption: processes of lower priorities make room for a queued process that fits on no host.

They move to other hosts. With `preemption: requeue`, those that cannot move wait in the queue
again. The set with the fewest processes is chosen; of equal sets the one with the lowest
priorities. Until the process is placed, its host takes no process of a lower priority; otherwise
that one could take the room.

A set is a union of groups: processes that must stay on one host leave it together.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations, islice
from math import inf
from typing import Final

import numpy as np

from rosrm.core.master import lifecycle
from rosrm.core.master.assignment.assign import demand_of, ranking_of
from rosrm.core.master.assignment.neighbours import awaited_neighbour, running_with
from rosrm.core.master.master_state import MasterState
from rosrm.core.master.migration.eviction import PlannedMoves, begin_moves, plan_moves
from rosrm.core.master.migration.room import (
    CLOSE,
    is_leaving,
    share_of,
    trial,
    why_it_cannot_move,
)
from rosrm.core.master.migration.start import moves_under_way
from rosrm.core.master.outcomes import Rejected
from rosrm.core.master.recovery.journal_gap import why_no_work
from rosrm.core.master.scheduling.candidates import candidates
from rosrm.core.master.scheduling.filters import FILTERS, OF_ROOM, passing
from rosrm.core.master.scheduling.ranking import Ranking
from rosrm.core.master.state.host_arrays import FloatArray
from rosrm.core.master.state.hosts import Host
from rosrm.core.master.state.moving import RoomMade
from rosrm.core.master.state.process import DesiredState, Instance, Process, ProcessPhase
from rosrm.model.event_kinds import EventKind
from rosrm.wording import few, listed

#: Seconds between two reviews.
_EVERY: Final = 1.0
#: Seconds for which a host stays reserved after the last departure, until its reading shows it.
_GRACE: Final = 5.0
#: Seconds after the last departure, after which the readings of a host show it.
_SHOWN: Final = 2.0
#: Most waiting processes, hosts of each, and sets of each host that one review considers.
_MOST_WAITING: Final = 4
_MOST_HOSTS: Final = 32
_MOST_SETS: Final = 64
#: Most combinations of one size that a review looks at on one host.
_MOST_COMBINATIONS: Final = 5_000
#: Most combinations of all sizes.
_MOST_TRIED: Final = 20_000
#: Most sets whose moves a review plans for one process.
_MOST_TRIALS: Final = 20
#: Most reasons against processes in one answer.
_MOST_REASONS: Final = 3

_OTHERS: Final = tuple(one for one in FILTERS if one.name not in OF_ROOM)


@dataclass(frozen=True, slots=True)
class Group:
    """Processes that leave a host together.

    Attributes:
        share: (R + 1,) fractions that they free, and their number.
    """

    instances: tuple[Instance, ...]
    processes: tuple[Process, ...]
    share: FloatArray


@dataclass(slots=True)
class _Search:
    """The search for room for one process.

    Attributes:
        tried: names of hosts where the process did not fit in spite of the room.
        against: reasons why processes of lower priorities cannot make room.
        stuck: names of processes that cannot leave their host, whichever others do.
    """

    process: Process
    ranking: Ranking
    tried: frozenset[str]
    against: list[str] = field(default_factory=list)
    stuck: set[str] = field(default_factory=set)


def preempt(state: MasterState, now: float) -> None:
    """Make room for the first waiting processes that fit nowhere, or continue to make it."""
    if now - state.preemption.reviewed < _EVERY:
        return
    state.preemption.reviewed = now
    waits = state.settings.preemption and len(state.queue) and not why_no_work(state, now)
    waiting = list(_waiting(state, now)) if waits else []
    made = {one.name: _review(state, one, now) for one in waiting}
    state.preemption.room_made = {name: room for name, room in made.items() if room is not None}
    claims: dict[int, int] = {}
    for name, room in state.preemption.room_made.items():
        if room.host is not None:
            priority, column = state.processes[name].spec.priority, room.host.column
            claims[column] = max(priority, claims.get(column, priority))
    state.hosts.set_claims(claims)


def _waiting(state: MasterState, now: float) -> Iterator[Process]:
    """Yield the processes that are placed next, and for which others may make room."""
    owners = (state.owned_by(one) for one in state.instances.values())
    lowest = min((one.spec.priority for one in owners if one is not None), default=inf)
    found = 0
    for name in state.queue:
        process = state.processes[name]
        if process.spec.priority <= lowest or found == _MOST_WAITING:
            return
        if name in state.queue.delayed or awaited_neighbour(state, process):
            continue
        if name in state.preemption.room_made or now - process.since >= state.settings.hysteresis:
            yield process
        found += 1
        if not state.settings.backfill:
            return


def _review(state: MasterState, process: Process, now: float) -> RoomMade | None:
    """Return the room that is made for a process; None: it needs none."""
    ranking = ranking_of(state, demand_of(state, process))
    if ranking.best() >= 0:
        return None
    before = state.preemption.room_made.get(process.name)
    if before is not None and now < before.until and before.host is None:
        return before
    search = _Search(process, ranking, before.tried if before is not None else frozenset())
    if before is not None and before.host is not None:
        return _continue(state, search, before.host, before, now)
    for host, missing in _hosts_in_question(state, search):
        if (missing - _leaving(state, host) <= CLOSE).all():  # also after a restart of the master
            return _wait_for_room(state, search, host, now)
    return _make_room(state, search, _hosts_in_question(state, search), now)


def _continue(
    state: MasterState, search: _Search, host: Host, before: RoomMade, now: float
) -> RoomMade | None:
    """Wait for the departures from a host, and begin those that had to wait for their turn."""
    leaving = _leaving(state, host)
    if not leaving.any() and not (before.partial and now >= before.until - _GRACE + _SHOWN):
        if now < before.until:
            return before
        return _in_vain(state, search, host, now)
    for one, missing in _hosts_in_question(state, search):
        if one is host:
            if (missing - leaving <= CLOSE).all():
                return _wait_for_room(state, search, host, now)
            if before.partial and leaving.any():
                return replace(before, until=now + _GRACE)
            return _make_room(state, search, [(host, missing)], now)
    return _in_vain(state, search, host, now)


def _in_vain(state: MasterState, search: _Search, host: Host, now: float) -> RoomMade:
    """Give up a host on which the process does not fit in spite of the room that was made."""
    why = f"room was made on {host.name}, and the process does not fit there"
    tried = search.tried | {host.name}
    return RoomMade(None, why, now + state.settings.cooldown, tried=tried)


def _wait_for_room(state: MasterState, search: _Search, host: Host, now: float) -> RoomMade:
    names = sorted(one.id.process for one in state.instances_of(host) if is_leaving(state, one))
    leave = "leaves" if len(names) == 1 else "leave"
    why = f"{listed(names)} {leave} {host.name} to make room"
    return RoomMade(host, why, now + _GRACE, tried=search.tried)


def _hosts_in_question(state: MasterState, search: _Search) -> list[tuple[Host, FloatArray]]:
    """Return the hosts that lack only room, and what each lacks; those that lack least first.

    What a host lacks is (R + 1,): fractions, and places for processes; values below 0 are spare.
    """
    table, ranking = state.hosts, search.ranking
    every = candidates(table, ranking.demand, ranking.need, slice(0, len(table)))
    closed = ~table.accepting
    closed[table.hosts_over_limit()] = False  # the missing room is judged by its readings
    columns = np.flatnonzero(passing(_OTHERS, every) & ~closed)
    missing = np.vstack(
        [table.busy + ranking.need - table.limit, table.processes - table.bound + 1.0]
    )[:, columns]  # fmt: skip
    missing = np.where(np.isnan(missing), -1.0, missing)  # no such resource
    order = np.argsort(np.maximum(missing, 0.0).sum(axis=0), kind="stable")
    found = [(table.hosts[columns[at]], missing[:, at]) for at in order]
    # Nothing is missing where a policy has a veto.
    return [one for one in found if (one[1] > CLOSE).any() and one[0].name not in search.tried]


def _leaving(state: MasterState, host: Host) -> FloatArray:
    """Return what the instances free that leave a host already, (R + 1,)."""
    leaving = [one for one in state.instances_of(host) if is_leaving(state, one)]
    return _shares(state, leaving)


def _shares(state: MasterState, instances: Sequence[Instance]) -> FloatArray:
    total = np.zeros(len(state.hosts.resources) + 1)
    for one in instances:
        total[:-1] += share_of(state, one)
        total[-1] += 1.0
    return total


# --- sets -------------------------------------------------------------------------------------


def _make_room(
    state: MasterState, search: _Search, hosts: Iterable[tuple[Host, FloatArray]], now: float
) -> RoomMade:
    """Let the smallest possible set of processes leave their host; return the outcome."""
    sets = [
        (rank(chosen), host, chosen)
        for host, missing in islice(_with_groups(state, search, hosts), _MOST_HOSTS)
        for chosen in _sets_on(state, search, host, missing, now)
    ]
    trials = 0
    for _, host, chosen in sorted(sets, key=lambda one: one[0]):
        if trials == _MOST_TRIALS:
            break
        if any(group.processes[0].name in search.stuck for group in chosen):
            continue
        trials += 1
        moves = _planned(state, search, chosen, now)
        if moves is not None:
            return _begin(state, search, host, chosen, moves, now)
    against = few(dict.fromkeys(search.against), _MOST_REASONS)
    why = f"no process of a lower priority can make room{': ' * bool(against)}{'; '.join(against)}"
    return RoomMade(None, why, now + _GRACE, tried=search.tried)


def _with_groups(
    state: MasterState, search: _Search, hosts: Iterable[tuple[Host, FloatArray]]
) -> Iterator[tuple[Host, FloatArray]]:
    """Yield the hosts with processes of lower priorities."""
    for host, missing in hosts:
        owners = (state.owned_by(one) for one in state.instances_of(host))
        if any(one and one.spec.priority < search.process.spec.priority for one in owners):
            yield host, missing


def rank(chosen: Sequence[Group]) -> tuple[int, list[int], float, list[str]]:
    """Return the order of a set: number, priorities from the highest, and what it frees."""
    processes = [one for group in chosen for one in group.processes]
    priorities = sorted((one.spec.priority for one in processes), reverse=True)
    freed = sum(float(group.share.sum()) for group in chosen)
    return len(processes), priorities, freed, sorted(one.name for one in processes)


def _sets_on(
    state: MasterState, search: _Search, host: Host, missing: FloatArray, now: float
) -> list[tuple[Group, ...]]:
    """Return the first sets of groups on a host that free what is missing."""
    groups = list(_groups(state, search, host, now))
    left = missing - _leaving(state, host)
    return list(islice(covering_sets(groups, left), _MOST_SETS))


def _groups(state: MasterState, search: _Search, host: Host, now: float) -> Iterator[Group]:
    """Yield the groups on a host that may leave it."""
    seen = set[str]()
    for instance in state.instances_of(host):
        process = state.owned_by(instance)
        if process is None or process.name in seen or is_leaving(state, instance):
            continue
        group = (process, *running_with(state, process))
        seen.update(one.name for one in group)
        why = next(filter(None, (_why_it_stays(state, search, one, now) for one in group)), "")
        if why:
            search.against.append(why)
            continue
        instances = tuple(state.instances[one.owner] for one in group)
        yield Group(instances, group, _shares(state, instances))


def _why_it_stays(state: MasterState, search: _Search, process: Process, now: float) -> str:
    """Return why a process does not make room; "" if it may."""
    if process.spec.priority >= search.process.spec.priority:
        return f"{process.name} has no lower priority ({process.spec.priority})"
    if process.spec.protect:
        return f"{process.name} is protected"
    if process.wanted is not DesiredState.RUN or process.name in state.migrations:
        return f"{process.name} is being moved or stopped"
    if state.settings.preemption == "requeue":
        return ""
    return why_it_cannot_move(state, process, now)


def covering_sets(groups: Sequence[Group], missing: FloatArray) -> Iterator[tuple[Group, ...]]:
    """Yield the sets of groups that free what is missing, the smallest first.

    A set with a superfluous group is left out. Of many groups only the first combinations of each
    size are tried, with the groups that free most of what is missing, and few combinations in all.
    """
    wanted = np.maximum(missing, CLOSE)
    ordered = sorted(groups, key=lambda one: -float((one.share / wanted)[missing > 0].sum()))
    shares = np.array([one.share for one in ordered]).reshape(len(ordered), len(missing))
    found: list[tuple[Group, ...]] = []
    tried = 0
    for size in range(_fewest(shares, missing), len(ordered) + 1):
        if tried >= _MOST_TRIED:
            break
        rows = np.array(list(islice(combinations(range(len(ordered)), size), _MOST_COMBINATIONS)))
        tried += len(rows)
        freed = shares[rows].sum(axis=1)
        covers = (freed >= missing - CLOSE).all(axis=1)
        without_one = freed[:, None, :] - shares[rows]
        spare = (without_one >= missing - CLOSE).all(axis=2).any(axis=1)
        found += [tuple(ordered[at] for at in row) for row in rows[covers & ~spare]]
        found.sort(key=rank)
        while found and rank(found[0])[0] <= size:  # no set of more groups has fewer processes
            yield found.pop(0)
    yield from found


def _fewest(shares: FloatArray, missing: FloatArray) -> int:
    """Return the least number of groups that may free what is missing; too many: none can."""
    freed = np.sort(shares, axis=0)[::-1].cumsum(axis=0)  # (n, R): highest sums of 1..n groups
    enough = freed >= missing - CLOSE
    if not len(shares) or not enough[-1].all():
        return len(shares) + 1
    return int(enough.argmax(axis=0).max()) + 1


# --- departures -------------------------------------------------------------------------------


def _planned(
    state: MasterState, search: _Search, chosen: Sequence[Group], now: float
) -> list[PlannedMoves | None] | None:
    """Return the moves of each group of a set, None for one that waits in the queue again.

    Return None if a group can do neither. The moves are planned together, so that each has room
    beside the others.
    """
    moves: list[PlannedMoves | None] = []
    rejected: Process | None = None
    with trial(state) as reserve:
        for group in chosen:
            planned = _plan(state, search.process, group.processes[0], now)
            if not isinstance(planned, Rejected):
                reserve(planned)
            elif state.settings.preemption != "requeue":
                rejected = group.processes[0]
                break
            moves.append(None if isinstance(planned, Rejected) else planned)
    if rejected is None:
        return moves
    alone = _plan(state, search.process, rejected, now) if moves else planned
    if isinstance(alone, Rejected):
        search.stuck.add(rejected.name)
        search.against.append(alone.reason)
    else:
        search.against.append(
            f"no hosts have room for all that would have to leave with {rejected.name}"
        )
    return None


def _plan(
    state: MasterState, preemptor: Process, process: Process, now: float
) -> PlannedMoves | Rejected:
    why = why_it_cannot_move(state, process, now)
    if why:
        return Rejected(why)
    cause = (
        f"it makes room for {preemptor.name}, which has a higher priority "
        f"({preemptor.spec.priority} over {process.spec.priority})"
    )
    return plan_moves(state, process, cause, now, headroom=state.settings.headroom)


def _begin(
    state: MasterState, search: _Search, host: Host, chosen: Sequence[Group],
    moves: Sequence[PlannedMoves | None], now: float,
) -> RoomMade:  # fmt: skip
    """Let a set leave its host; moves beyond `max_migrations` begin in a later review."""
    phrases, partial = [], False
    for group, planned in zip(chosen, moves, strict=True):
        names = listed([one.name for one in group.processes])
        if planned is None:
            for process, instance in zip(group.processes, group.instances, strict=True):
                _requeue(state, search.process, process, instance, now)
            phrases.append(f"{names} wait{'s' * (len(group.processes) == 1)} in the queue again")
            continue
        number = len(planned.steps)
        if moves_under_way(state) + number > state.settings.max_migrations:
            partial = True
            continue
        for process in group.processes:
            there = f"it moves to {planned.destination.name}"
            _record(state, search.process, process, host, there, now)
        begin_moves(state, planned, now)
        phrases.append(f"{names} move{'s' * (number == 1)} to {planned.destination.name}")
    if not phrases:
        why = "other moves are under way (`migration.max_in_flight`)"
        return RoomMade(None, f"no process can make room yet: {why}", now, tried=search.tried)
    why = f"room is made on {host.name}: {'; '.join(phrases)}"
    return RoomMade(host, why, now + _GRACE, partial, search.tried)


def _requeue(
    state: MasterState, preemptor: Process, process: Process, instance: Instance, now: float
) -> None:
    _record(state, preemptor, process, instance.host, "it waits in the queue again", now)
    process.wanted = DesiredState.REQUEUE
    why = f"makes room for {preemptor.name}"
    state.set_phase(process, ProcessPhase.STOPPING, now, why)
    state.save(process)
    lifecycle.stop_instance(state, instance, now)


def _record(
    state: MasterState, preemptor: Process, process: Process, host: Host, what: str, now: float
) -> None:
    """Record a preemption for both processes."""
    priorities = f"{preemptor.spec.priority} over {process.spec.priority}"
    message = (
        f"{process.name} makes room on {host.name} for {preemptor.name}, which has a higher "
        f"priority ({priorities}): {what}"
    )
    for one, other in ((process, preemptor), (preemptor, process)):
        facts = {"host": host.name, "for": preemptor.name, "from": other.name}
        state.record(now, EventKind.PREEMPTED, message, process=one.name, facts=facts)
