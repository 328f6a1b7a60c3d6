"""Preemption: processes of lower priorities make room for a queued process that fits on no host.

They move to other hosts. With `preemption: requeue`, those that cannot move wait in the queue
again. The set with the fewest processes is chosen; of equal sets the one with the lowest
priorities. Processes of other users make room only for a process of an operator, because another
owner could not stop them by a request. Until the process is placed, its host takes no process of a
lower priority; otherwise that one could take the room. Such a claim ends with the placement, when
the process does not fit in spite of the room, or at its deadline; the host is then tried again only
after a back-off.

Nothing leaves a host unless the process, with its whole gang, would find its places then.

A set is a union of groups: processes that must stay on one host leave it together.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from collections.abc import Set as AbstractSet
from dataclasses import dataclass, field, replace
from itertools import combinations, islice
from math import inf
from typing import Final

import numpy as np

from rosrm.core.master import lifecycle
from rosrm.core.master.assignment.assign import first_request_awaited, held_back
from rosrm.core.master.assignment.demands import demand_of, ranking_of
from rosrm.core.master.assignment.gang_search import Blocked, find_places
from rosrm.core.master.assignment.gangs import members_of
from rosrm.core.master.assignment.neighbours import running_with
from rosrm.core.master.assignment.places import array_without_place, wanted_places
from rosrm.core.master.master_state import MasterState
from rosrm.core.master.migration.eviction import PlannedMoves, begin_moves, plan_moves
from rosrm.core.master.migration.room import (
    CLOSE,
    Trial,
    is_leaving,
    share_of,
    trial,
    why_it_cannot_move,
)
from rosrm.core.master.migration.start import may_begin
from rosrm.core.master.outcomes import Rejected
from rosrm.core.master.recovery.journal_gap import why_no_work
from rosrm.core.master.rights import may_affect
from rosrm.core.master.scheduling.candidates import candidates
from rosrm.core.master.scheduling.filters import FILTERS, OF_ROOM, passing
from rosrm.core.master.scheduling.ranking import Ranking
from rosrm.core.master.state.arrays import ArrayKey
from rosrm.core.master.state.backoff import Retries
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
#: Seconds for each process of a set, after which a host is given up that they have not left.
_LONGEST: Final = 120.0
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


#: Moves of the groups of a set; None for one that waits in the queue again.
_Moves = Sequence[PlannedMoves | None]
_Choice = tuple[Host, Sequence[Group], _Moves]


@dataclass(slots=True)
class _Search:
    """The search for room for one process.

    Attributes:
        tried: hosts where the process did not fit in spite of the room.
        claim: room that is being made for the process; None: none is.
        against: reasons why processes of lower priorities cannot make room.
        stuck: names of processes that cannot leave their host, whichever others do.
        freed: numbers of instances that have left already, in a trial.
    """

    process: Process
    ranking: Ranking
    tried: Retries
    claim: RoomMade | None
    against: list[str] = field(default_factory=list)
    stuck: set[str] = field(default_factory=set)
    freed: AbstractSet[int] = frozenset()

    def deadline(self, departures: int, now: float) -> float:
        """Return the deadline of a claim; a claim that continues keeps its own."""
        return now + departures * _LONGEST if self.claim is None else self.claim.deadline


def preempt(state: MasterState, now: float) -> None:
    """Make room for the first waiting processes that fit nowhere, or continue to make it."""
    known, last = state.preemption, state.preemption.reviewed
    if now - last < _EVERY:
        return
    known.reviewed = now
    if not state.settings.preemption:
        known.room_made.clear()
    for name in list(known.room_made):
        if name not in state.queue or state.processes[name].since > last:  # placed, or another one
            del known.room_made[name]
    _set_claims(state)
    if not state.settings.preemption or not len(state.queue):
        return
    if why_no_work(state, now) or first_request_awaited(state, now):
        return  # while the master assigns no work, the claims stand as they are
    _review_waiting(state, now)


def _review_waiting(state: MasterState, now: float) -> None:
    """Review the first waiting processes, and all for which room is being made."""
    made, held = state.preemption.room_made, held_back(state, now)
    claimed = [state.processes[name] for name, room in made.items() if room.host is not None]
    due = {one.name: one for one in (*claimed, *_waiting(state, held, now))}
    for process in sorted(due.values(), key=lambda one: state.queue.key_of(one.name)):
        if process.name in held and now < made[process.name].deadline:
            continue  # its claim stands, but nothing more is stopped for it
        room = _review(state, process, made.pop(process.name, None), now)
        if room is not None:
            made[process.name] = room
        _set_claims(state)
    for name in made.keys() - due.keys():
        made[name] = replace(made[name], reason="")  # the process is not among the first any more


def _set_claims(state: MasterState) -> None:
    """Reserve each host on which room is made for the highest priority for which it is."""
    claims: dict[int, int] = {}
    for name, room in state.preemption.room_made.items():
        if room.host is not None:
            priority, column = state.processes[name].spec.priority, room.host.column
            claims[column] = max(priority, claims.get(column, priority))
    state.hosts.set_claims(claims)


def _waiting(state: MasterState, held: AbstractSet[str], now: float) -> Iterator[Process]:
    """Yield the processes that are placed next, and for which others may make room.

    `held`: names of those that could not start then.
    """
    owners = (state.owned_by(one) for one in state.instances.values())
    lowest = min((one.spec.priority for one in owners if one is not None), default=inf)
    found, first = 0, None
    counted, places = set[object](), Counter[ArrayKey]()
    for name in state.queue:
        process = state.processes[name]
        if first is not None and (process.gang is None or process.gang != first.gang):
            return  # without backfill: after the first process with its gang
        if process.spec.priority <= lowest or found == _MOST_WAITING:
            return
        if name in held:
            continue
        if (process.gang or name) not in counted:
            if array_without_place(state, process, places) is not None:
                continue
            counted.add(process.gang or name)
            places += wanted_places(state, process)
        if now - process.since >= state.settings.hysteresis:
            yield process
        found += 1
        if not state.settings.backfill:
            first = first or process


def _review(
    state: MasterState, process: Process, before: RoomMade | None, now: float
) -> RoomMade | None:
    """Return the room that is made for a process; None: it needs none."""
    claim = before if before is not None and before.host is not None else None
    ranking = ranking_of(state, demand_of(state, process))
    search = _Search(process, ranking, before.tried if before else Retries(), claim)
    if ranking.best() >= 0:  # the claim stands until the process is placed
        if claim is None:
            return None if before is None or now >= before.until else before
        if now < claim.deadline:
            return claim
        why = f"room was made on {_name_of(claim)}, but the process was not placed in time"
        return _given_up(state, search, claim, why, now)
    if before is not None and claim is None and now < before.until:
        return before
    if claim is not None:
        return _continue(state, search, claim, now)
    hosts = [
        one for one in _hosts_in_question(state, search, now)
        if process.spec.priority > state.hosts.claims.get(one[0].column, -inf)
    ]  # fmt: skip
    for host, missing in hosts:
        if (missing - _leaving(state, host) <= CLOSE).all():  # also after a restart of the master
            return _wait_for_room(state, search, host, now)
    return _make_room(state, search, hosts, now)


def _continue(state: MasterState, search: _Search, claim: RoomMade, now: float) -> RoomMade:
    """Wait for the departures from a host, and begin those that had to wait for their turn."""
    host = claim.host
    assert host is not None
    if now >= claim.deadline:
        return _expired(state, search, claim, now)
    leaving = _leaving(state, host)
    missing = next(
        (lacks for one, lacks in _hosts_in_question(state, search, now) if one is host), None
    )
    shown = claim.partial and now >= claim.until - _GRACE + _SHOWN
    if missing is None or not (leaving.any() or shown):
        return _wait_for_host(state, search, claim, now)
    if (missing - leaving <= CLOSE).all():
        return _wait_for_room(state, search, host, now)
    if claim.partial and leaving.any():
        return replace(claim, until=now + _GRACE)
    return _make_room(state, search, [(host, missing)], now)


def _wait_for_host(state: MasterState, search: _Search, claim: RoomMade, now: float) -> RoomMade:
    """Wait for the readings of a host, and while it cannot take the process for another reason.

    A host may be suspect or have a stale reading for a moment, or is claimed for a higher priority.
    """
    host = claim.host
    assert host is not None
    taken = state.hosts.claims.get(host.column, -inf) > search.process.spec.priority
    if taken or _leaving(state, host).any():
        return replace(claim, until=now + _GRACE)
    if now < claim.until:
        return claim
    why = f"room was made on {host.name}, but the process does not fit there"
    return _given_up(state, search, claim, why, now)


def _expired(state: MasterState, search: _Search, claim: RoomMade, now: float) -> RoomMade:
    """Give up a host that its processes do not leave in time."""
    host = claim.host
    assert host is not None
    leaving = [one.id.process for one in state.instances_of(host) if is_leaving(state, one)]
    why = f"{listed(sorted(leaving))} did not leave {host.name} in time to make room"
    if not leaving:
        why = f"the room on {host.name} could not be made in time"
    return _given_up(state, search, claim, why, now)


def _given_up(
    state: MasterState, search: _Search, claim: RoomMade, why: str, now: float
) -> RoomMade:
    """Return the outcome for a host where room was made without success; it is tried later."""
    search.tried.note(_name_of(claim), why, now, _LONGEST)
    return RoomMade(None, why, now + state.settings.cooldown, tried=search.tried)


def _name_of(claim: RoomMade) -> str:
    assert claim.host is not None
    return claim.host.name


def _wait_for_room(state: MasterState, search: _Search, host: Host, now: float) -> RoomMade:
    names = sorted(one.id.process for one in state.instances_of(host) if is_leaving(state, one))
    leave = "leaves" if len(names) == 1 else "leave"
    why = f"{listed(names)} {leave} {host.name} to make room"
    deadline = search.deadline(len(names), now)
    return RoomMade(host, why, now + _GRACE, tried=search.tried, deadline=deadline)


def _hosts_in_question(
    state: MasterState, search: _Search, now: float
) -> list[tuple[Host, FloatArray]]:
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
    failed = search.tried.waiting(now)
    return [one for one in found if (one[1] > CLOSE).any() and one[0].name not in failed]


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
    choice = _choose(state, search, hosts, now)
    if choice is not None:
        return _begin(state, search, *choice, now)
    against = few(dict.fromkeys(search.against), _MOST_REASONS)
    why = f"no process of a lower priority can make room{': ' * bool(against)}{'; '.join(against)}"
    return RoomMade(None, why, now + _GRACE, tried=search.tried)


def _choose(
    state: MasterState, search: _Search, hosts: Iterable[tuple[Host, FloatArray]], now: float,
    *, in_trial: bool = False,
) -> _Choice | None:  # fmt: skip
    """Return the smallest set that can leave its host, so that the whole gang finds its places.

    `in_trial`: room is made for another process of the gang, which is checked as a whole.
    """
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
        if moves is None:
            continue
        if in_trial or _all_fit(state, search, chosen, moves, now):
            return host, chosen, moves
    return None


def _all_fit(
    state: MasterState, search: _Search, chosen: Sequence[Group], moves: _Moves, now: float
) -> bool:
    """Return True if a process and its whole gang would find places after some departures.

    Others may make room for its other processes, too.
    """
    members = members_of(state, search.process)
    with trial(state) as tried:
        tried.free(one for one in state.instances.values() if is_leaving(state, one))
        for _ in members:
            _depart(tried, chosen, moves)
            found = find_places(state, members)
            if not isinstance(found, Blocked):
                return True
            other = found.process
            ranking = ranking_of(state, demand_of(state, other))
            next_search = _Search(other, ranking, search.tried, None, freed=tried.freed)
            hosts = _hosts_in_question(state, next_search, now)
            choice = _choose(state, next_search, hosts, now, in_trial=True)
            if choice is None:
                break
            _, chosen, moves = choice
    beside = f" for {other.name} of its gang" if other is not search.process else ""
    search.against.append(f"there would still be no room{beside}")
    return False


def _depart(tried: Trial, chosen: Sequence[Group], moves: _Moves) -> None:
    """Let groups leave their host in a trial."""
    for group, planned in zip(chosen, moves, strict=True):
        tried.free(group.instances)
        if planned is not None:
            tried.reserve(planned)


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
        if instance.id.number in search.freed:
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
    if not may_affect(search.process, process):
        return f"{process.name} belongs to another user"
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
) -> _Moves | None:
    """Return the moves of each group of a set, None for one that waits in the queue again.

    Return None if a group can do neither. The moves are planned together, so that each has room
    beside the others.
    """
    moves: list[PlannedMoves | None] = []
    rejected: Process | None = None
    with trial(state) as tried:
        for group in chosen:
            planned = _plan(state, search.process, group.processes[0], now)
            if not isinstance(planned, Rejected):
                tried.reserve(planned)
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
    moves: _Moves, now: float,
) -> RoomMade:  # fmt: skip
    """Let a set leave its host; moves beyond `max_migrations` begin in a later review.

    A host that is claimed already stays claimed while no move can begin.
    """
    phrases, partial = [], False
    for group, planned in zip(chosen, moves, strict=True):
        names = listed([one.name for one in group.processes])
        if planned is None:
            for process, instance in zip(group.processes, group.instances, strict=True):
                _requeue(state, search.process, process, instance, now)
            phrases.append(f"{names} wait{'s' * (len(group.processes) == 1)} in the queue again")
            continue
        number = len(planned.steps)
        if not may_begin(state, number):
            partial = True
            continue
        for process in group.processes:
            there = f"it moves to {planned.destination.name}"
            _record(state, search.process, process, host, there, now)
        begin_moves(state, planned, now)
        phrases.append(f"{names} move{'s' * (number == 1)} to {planned.destination.name}")
    if not phrases:
        why = "no process can make room yet: other moves are under way (`migration.max_in_flight`)"
        if search.claim is not None:
            return replace(search.claim, reason=why, until=now + _GRACE, partial=True)
        return RoomMade(None, why, now, tried=search.tried)
    why = f"room is made on {host.name}: {'; '.join(phrases)}"
    deadline = search.deadline(sum(len(group.processes) for group in chosen), now)
    return RoomMade(host, why, now + _GRACE, partial, search.tried, deadline)


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
