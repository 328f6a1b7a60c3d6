"""Eviction: processes leave a host that is over a limit or is being drained.

An evicted process must lower the usage that is over its limit, and fit on its destination without
putting that host over a limit. Of such processes, the one with the largest usage moves. If no host
has room, no process moves.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from math import inf
from typing import Final

from rosrm.core.master.assignment.assign import (
    demand_amounts,
    demand_to_move,
    joint_demand,
    measured_need,
    unable,
)
from rosrm.core.master.assignment.demands import ranking_of
from rosrm.core.master.assignment.neighbours import moving_neighbour, running_with
from rosrm.core.master.hosts import capabilities
from rosrm.core.master.master_state import MasterState
from rosrm.core.master.migration.start import (
    begin_move,
    moves_under_way,
    plan_move,
    why_busy,
    why_cooling_down,
    why_immovable,
    why_never_movable,
    why_no_executor,
    without_executor,
)
from rosrm.core.master.outcomes import Rejected
from rosrm.core.master.scheduling.decision import (
    NO_ROOM,
    decide,
    verdict_of,
    why_each_refuses,
)
from rosrm.core.master.scheduling.feasibility import may_ever_take, why_each_never
from rosrm.core.master.scheduling.ranking import Ranking
from rosrm.core.master.state.demand import Demand
from rosrm.core.master.state.hosts import Host, HostCondition
from rosrm.core.master.state.migration import Migration
from rosrm.core.master.state.process import DesiredState, Instance, Process
from rosrm.model.event_kinds import EventKind
from rosrm.model.values import InstanceState
from rosrm.wording import by_reason, counted, each_of, few, listed

#: Shortest time, in seconds, between two `nothing_moves` records of a host with different reasons.
_RECORD_PERIOD: Final = 10.0
#: Highest number of hosts of which one answer gives the reasons; more plugin calls take too long.
_MOST_HOSTS: Final = 16
#: Highest number of a strategy's reasons against hosts in one answer.
_MOST_REASONS: Final = 3
_UNMEASURED: Final = "and its use by single processes is not measured"
_ALONE: Final = "there is no other host"


def evict_from_hosts(state: MasterState, now: float) -> None:
    """Move processes off draining hosts and off hosts over a limit for long enough."""
    _note_limits(state, now)
    concerned = [one for one in state.hosts.listed() if one.draining or one.over_since]
    for host in concerned:
        if host.draining:
            _note_drained(state, host, now)
    for host in concerned:
        if moves_under_way(state) >= state.settings.max_migrations:
            return
        if host.draining:
            if not host.drained:
                _drain(state, host, now)
        elif state.settings.automatic and host.over_since:
            _evict(state, host, now)


def _note_limits(state: MasterState, now: float) -> None:
    """Note for each host the exceeded limits with the times since when they are exceeded."""
    over = {int(column) for column in state.hosts.hosts_over_limit()}
    # Only hosts that are or were over a limit are checked, because most hosts never are.
    noted = (state.hosts.hosts[column] for column in sorted(over | state.hosts.noted_over))
    concerned = [host for host in noted if not host.pruned]
    for host in concerned:
        # A stale reading does not show whether the host is over its limit.
        stale = state.hosts.stale_resources(host) if state.hosts.stale[host.column] else ()
        if host.over_at and state.hosts.condition_of(host) is not HostCondition.UP:
            stale = tuple(host.over_at)
        names = state.hosts.over_limit(host.column) if host.column in over else []
        names = [name for name in names if name not in stale]
        host.over_at.update({name: now for name in stale if name in host.over_at})
        for name in names:
            host.over_since.setdefault(name, now)
            host.exceeded_since.setdefault(name, now)
            if name not in host.over_at:
                state.record(
                    now, EventKind.OVER_LIMIT, f"{host.name} reached its limit of {name}",
                    host=host.name, facts={"resource": name},
                )  # fmt: skip
            host.over_at[name] = now
        for name in host.over_since.keys() - names:
            del host.over_since[name], host.exceeded_since[name]
        if len(host.over_at) > len(names):
            _note_under_limit(state, host, now)
    state.hosts.noted_over = {host.column for host in concerned if host.over_at or host.over_since}


def _note_under_limit(state: MasterState, host: Host, now: float) -> None:
    """Record that a host is under its limits, after it was for the time `hysteresis`.

    Otherwise a usage near the limit would write many records a minute.
    """
    for name, at in list(host.over_at.items()):
        if name not in host.over_since and now - at >= state.settings.hysteresis:
            del host.over_at[name]
    if not host.over_at:
        host.blocked.clear()
        state.record(now, EventKind.UNDER_LIMIT, f"{host.name} is under its limits", host=host.name)


def _evict(state: MasterState, host: Host, now: float) -> None:
    if any(migration.source_host is host for migration in state.migrations.values()):
        return  # first wait for the effect of the current migration
    for resource, since in list(host.over_since.items()):
        due = now - since >= state.settings.hysteresis
        if due and _evict_for_resource(state, host, resource, now):
            return


def _evict_for_resource(state: MasterState, host: Host, resource: str, now: float) -> bool:
    """Begin to move one process; return False, and record why, if none can leave."""
    reasons = []
    for name, planned in evictions(state, host, resource, now):
        if isinstance(planned, PlannedMoves):
            begin_moves(state, planned, now)
            return True
        reasons.append((name, planned.reason))
    _record_nothing_moves(state, host, resource, reasons, now)
    return False


def evictions(
    state: MasterState, host: Host, resource: str, now: float
) -> Iterator[tuple[str, PlannedMoves | Rejected]]:
    """Yield the processes of a host, the largest users of a resource first, with moves or reasons.

    If no process declares a need of the resource, the only item has the name "" and that reason.
    """
    largest = _largest_first(state, host, resource)
    if largest and not any(_accounts_for(instance, resource) for instance in largest):
        # Without their names, because each new process would cause another record.
        yield "", Rejected(f"no process on it declares a need of {resource}, {_UNMEASURED}")
        return
    for instance in largest:
        process = state.processes[instance.id.process]
        reason = _why_not_now(state, process, instance, resource, now)
        cause, headroom = f"{host.name} is over its limit of {resource}", state.settings.headroom
        planned = (
            Rejected(reason)
            if reason
            else plan_moves(state, process, cause, now, headroom=headroom)
        )
        yield process.name, planned


def _largest_first(state: MasterState, host: Host, resource: str) -> list[Instance]:
    held = state.instances_of(host)
    owned = [instance for instance in held if state.owned_by(instance) is not None]
    return sorted(owned, key=lambda one: (-_usage_to_free(one, resource), one.id.number))


def _accounts_for(instance: Instance, resource: str) -> bool:
    """Return True if the usage of an instance is measured, or its need is known."""
    is_measured = resource in instance.seen or resource in instance.host.attributed
    return is_measured or resource in instance.demand


def _usage_to_free(instance: Instance, resource: str) -> float:
    """Return the usage, in base units of the resource, that moving an instance frees."""
    return instance.seen.get(resource, instance.demand.get(resource, 0.0))


def _why_not_now(
    state: MasterState, process: Process, instance: Instance, resource: str, now: float
) -> str:
    refusal = why_immovable(state, process)
    if refusal:
        return refusal
    if _usage_to_free(instance, resource) <= 0.0:
        if not _accounts_for(instance, resource):
            return f"{process.name} declares no need of {resource}, {_UNMEASURED}"
        return f"{process.name} uses no {resource}"
    cooling_down = why_cooling_down(state, process, now)
    if cooling_down:
        return cooling_down
    if instance.state is not InstanceState.READY:
        return f"{process.name} is not ready"
    return ""


def try_move(
    state: MasterState, process: Process, cause: str, now: float, *, headroom: float = 0.0,
    host: Host | None = None, asked: bool = False,
) -> Rejected | None:  # fmt: skip
    """Move a process to the host with the largest margin, or to a given one.

    The processes that must stay on one host with it move along. A host that lacks an executor of a
    plan is skipped, unless it was given; and so is one to which a move has failed, for a time that
    doubles with each failure, unless a user has `asked` for the move.

    Returns:
        None; or the reason why the process cannot be moved, and nothing has changed.
    """
    planned = plan_moves(state, process, cause, now, headroom=headroom, host=host, asked=asked)
    if isinstance(planned, Rejected):
        return planned
    begin_moves(state, planned, now)
    return None


@dataclass(frozen=True, slots=True)
class PlannedMoves:
    """The move of a process, with the moves of those that must stay on one host with it.

    Attributes:
        steps: for each process its migration, its own ranking, and the ranking that chose the host.
    """

    destination: Host
    steps: tuple[tuple[Process, Migration, Ranking, Ranking], ...]


def begin_moves(state: MasterState, planned: PlannedMoves, now: float) -> None:
    """Begin planned moves."""
    for process, migration, own, judged in planned.steps:
        decision = decide(judged, chosen=planned.destination.column)
        begin_move(state, process, migration, own, now)
        state.note_decision(process, decision, "migrated", now)


def plan_moves(
    state: MasterState, process: Process, cause: str, now: float, *, headroom: float = 0.0,
    host: Host | None = None, asked: bool = False,
) -> PlannedMoves | Rejected:  # fmt: skip
    """Plan the move of a process as `try_move` does; return the reason if it cannot be moved."""
    moving = [process, *running_with(state, process)]
    refusal = why_immovable(state, process) or _why_bound(state, moving)
    if not asked:
        refusal = refusal or next(filter(None, (_why_too_soon(one, now) for one in moving)), "")
    if refusal:
        return Rejected(refusal)
    source, lacking = state.instances[process.owner].host, dict[str, str]()
    failed = {} if asked else _failed_destinations(moving, now)
    while True:
        rankings = _rankings_to_move(state, moving, headroom, {**failed, **lacking})
        ranking = _joint_ranking(state, rankings)
        destination = _destination(state, process, ranking, source, host)
        if isinstance(destination, Rejected):
            return Rejected("; ".join(dict.fromkeys(lacking.values()))) if lacking else destination
        migrations = _planned_moves(state, moving, destination, cause, now)
        if isinstance(migrations, Rejected):
            return migrations
        unfit = [(one, why) for one in migrations if (why := why_no_executor(state, one))]
        if not unfit:
            break
        migration, why = unfit[0]
        hosts, shared = without_executor(state, migration)
        if host is not None or not hosts:
            return Rejected(why)
        lacking.update(dict.fromkeys(hosts, shared))
    steps = [
        (one, migration, rankings[one.name], ranking if one is process else rankings[one.name])
        for one, migration in zip(moving, migrations, strict=True)
    ]
    return PlannedMoves(destination, tuple(steps))


def _why_too_soon(process: Process, now: float) -> str:
    """Return why a process must not be moved so soon after a failed move; "": it may."""
    why = process.moves.why_none(now)
    return f"{process.name} is not moved again yet: {why}" if why else ""


def _failed_destinations(moving: Sequence[Process], now: float) -> dict[str, str]:
    return {host: why for one in moving for host, why in one.moves.waiting(now).items()}


def hosts_to_move_to(state: MasterState, process: Process) -> list[str]:
    """Return the hosts to which a process can be moved now, at most 16, the best first.

    A host may still lack an executor of the plan, which only the strategy knows.
    """
    moving = [process, *running_with(state, process)]
    if why_immovable(state, process) or _why_bound(state, moving):
        return []
    ranking = _joint_ranking(state, _rankings_to_move(state, moving, 0.0, {}))
    return [state.hosts.hosts[column].name for column in ranking.in_order()[:_MOST_HOSTS]]


def _joint_ranking(state: MasterState, rankings: Mapping[str, Ranking]) -> Ranking:
    """Return the ranking of hosts that take all of some processes."""
    demands = {name: ranking.demand for name, ranking in rankings.items()}
    return ranking_of(state, joint_demand(state, demands))


def _why_bound(state: MasterState, moving: Sequence[Process]) -> str:
    """Return why a process cannot move for the sake of those near it; "": they move, too."""
    process, *others = moving
    for one in others:
        refusal = why_immovable(state, one)
        if refusal:
            return f"{process.name} must stay near {one.name}, and {refusal}"
    for one in moving:
        other = moving_neighbour(state, one)
        if other:
            return f"{one.name} must stay near {other}, and {why_busy(state.migrations[other])}"
    return ""


def _rankings_to_move(
    state: MasterState, moving: Sequence[Process], headroom: float, avoided: Mapping[str, str]
) -> dict[str, Ranking]:
    """Return the ranking of each process, as if the others had moved already."""
    names = {one.name for one in moving}
    rankings = {}
    for one in moving:
        source = state.instances[one.owner]
        demand = demand_to_move(
            state, one, source.measured, source.host.name, headroom, avoided, together=names
        )
        rankings[one.name] = ranking_of(state, demand)
    return rankings


def _planned_moves(
    state: MasterState, moving: Sequence[Process], destination: Host, cause: str, now: float
) -> list[Migration] | Rejected:
    """Return the plan of each process, or the first reason why there is none."""
    planned = []
    for one in moving:
        migration = plan_move(state, one, destination, cause, now)
        if isinstance(migration, Rejected):
            return migration
        planned.append(migration)
        cause = f"it must run near {moving[0].name}, which moves there"
    return planned


def _destination(
    state: MasterState, process: Process, ranking: Ranking, source: Host, host: Host | None
) -> Host | Rejected:
    """Return the best host of a ranking, or the given host if it fits; else the reason."""
    if host is None:
        column = ranking.best()
        if column < 0:
            return Rejected(_why_nowhere(state, process, ranking, source))
        return state.hosts.hosts[column]
    if host is source:
        return Rejected(f"{process.name} runs on {host.name} already")
    if not ranking.fits(host.column):
        why = verdict_of(ranking, host.column).reason
        return Rejected(f"{process.name} does not fit on {host.name}: {why or 'no room'}")
    return host


def _is_alone(state: MasterState, source: Host) -> bool:
    return all(host is source for host in state.hosts.listed())


def _why_nowhere(state: MasterState, process: Process, ranking: Ranking, source: Host) -> str:
    """Return why no other host can take a process now: each reason once, with its hosts."""
    others = [host for host in state.hosts.listed() if host is not source]
    if not others:
        return _ALONE
    unable_hosts = unable(state, process, source.name)
    asked = [host for host in others if host.name not in unable_hosts]
    found = why_each_refuses(ranking, [host.column for host in asked[:_MOST_HOSTS]])
    if len(asked) == len(others) and all(reason == NO_ROOM for _, reason in found):
        return f"no host has room for {process.name}"
    more = counted(len(asked) - _MOST_HOSTS, "more host") if len(asked) > _MOST_HOSTS else ""
    faults = capabilities.faults(state, process.spec.migration.strategy or "", source)
    reasons = [by_reason(found), more, *few(faults, _MOST_REASONS)]
    return f"no host can take {process.name}: {'; '.join(filter(None, reasons))}"


# --- drain ------------------------------------------------------------------------------------


def departures(state: MasterState, host: Host, now: float) -> str:
    """Return phrases on the processes that leave a draining host, that wait for it, and cannot."""
    names, staying = _leaving(state, host, now), _staying(state, host, now)
    unreachable = state.hosts.why_unreachable(host)
    if not names and not unreachable:
        return f"nothing can leave: {'; '.join(few(staying))}" if staying else "no process is left"
    waits = {name: why for name in names if (why := _why_not_yet(state, name, now))}
    leaving = [name for name in names if name not in waits]
    phrases = []
    if leaving:
        count = counted(len(leaving), "process leaves", "processes leave")
        phrases.append(f"{count} ({listed(leaving)})")
    if waits:
        count = counted(len(waits), "process cannot leave yet", "processes cannot leave yet")
        phrases.append(f"{count}: {'; '.join(few(_grouped(waits.items())))}")
    if staying:
        phrases.append(f"cannot leave: {'; '.join(few(staying))}")
    if unreachable:
        unknown = f"the {'other ' * bool(phrases)}processes there are not known"
        phrases.append(f"{unknown}, because the host {unreachable}")
    return "; ".join(phrases)


def _why_not_yet(state: MasterState, name: str, now: float) -> str:
    """Return why a process that will leave its host does not move now; "": it moves, or ends."""
    process = state.processes[name]
    if name in state.migrations or process.wanted is not DesiredState.RUN:
        return ""
    planned = plan_moves(state, process, "", now)
    return planned.reason if isinstance(planned, Rejected) else ""


def _leaving(state: MasterState, host: Host, now: float) -> list[str]:
    """Return the processes whose instances on a host will move away or end."""
    held = state.instances_of(host)
    return sorted({one.id.process for one in held if not _why_it_stays(state, one, now)})


def _staying(state: MasterState, host: Host, now: float) -> list[str]:
    """Return the reasons why processes cannot leave a host, each reason once."""
    held = state.instances_of(host)
    found = [(one.id.process, _why_it_stays(state, one, now)) for one in held]
    reasons = [(name, reason) for name, reason in found if reason]
    return _grouped(reasons + _images_on(state, host))


def _grouped(reasons: Iterable[tuple[str, str]]) -> list[str]:
    """Return each reason once, for all its processes: "each of a and b is not ready".

    Args:
        reasons: name of the process, and its reason as a whole sentence.
    """
    names = defaultdict[tuple[str, bool], list[str]](list)
    for name, reason in dict.fromkeys(reasons):
        predicate = reason.removeprefix(f"{name} ")
        names[predicate, predicate != reason].append(name)
    return [f"{each_of(alike)} {text}" if named else text for (text, named), alike in names.items()]


def _why_it_stays(state: MasterState, instance: Instance, now: float) -> str:
    """Return why an instance stays on its host; "" if it can move or is about to end.

    The instance also stays while its moves to all other hosts have failed, until the master tries
    one again.
    """
    process, source = state.owned_by(instance), instance.host
    if process is None or process.wanted is not DesiredState.RUN:
        return ""
    if process.name in state.migrations:
        return ""
    reason = why_never_movable(state, process)
    if reason:
        return reason
    # Only labels, resources and exclusions count here. A missing capability, or a lost host, may
    # change later.
    failed = process.moves.waiting(now)
    lasting = {**process.forbidden_hosts, **failed, source.name: "it is there"}
    measured = measured_need(state, instance.measured)
    amounts, estimated = demand_amounts(state, process, measured)
    demand = Demand(process.spec, amounts, estimated, lasting, plugins=state.placement)
    possible = may_ever_take(state.hosts, demand)
    if any(possible[host.column] for host in state.hosts.listed() if host is not source):
        return ""
    if _is_alone(state, source):
        return _ALONE
    others = [host.column for host in state.hosts.listed() if host is not source]
    why = by_reason(why_each_never(state.hosts, demand, others[:_MOST_HOSTS]))
    again = "; the move is tried again later" if failed else ""
    return f"{process.name} may run on no other host: {why}{again}"


def _note_drained(state: MasterState, host: Host, now: float) -> None:
    """Record once that a host is drained: every process left on it cannot leave."""
    if state.hosts.why_unreachable(host):
        return
    host.drained = all(_why_it_stays(state, one, now) for one in state.instances_of(host))
    if not host.drained:
        return
    left = departures(state, host, now)
    if host.blocked.get("drained") != left:  # the remaining processes may try to leave again
        host.blocked["drained"] = left
        message = f"{host.name} is drained: {left}"
        state.record(now, EventKind.HOST_DRAINED, message, host=host.name)


def _drain(state: MasterState, host: Host, now: float) -> None:
    reasons = []
    for instance in _largest_first(state, host, "memory"):
        process = state.processes[instance.id.process]
        if moves_under_way(state) >= state.settings.max_migrations:
            return
        if process.name in state.migrations:
            continue
        rejected = try_move(state, process, f"{host.name} is being drained", now)
        if rejected is not None:
            reasons.append((process.name, rejected.reason))
    reasons += _images_on(state, host)
    if reasons:
        _record_nothing_moves(state, host, "drain", reasons, now)


def _images_on(state: MasterState, host: Host) -> list[tuple[str, str]]:
    """Return a reason for each image on a host; images are restored in place, so they stay."""
    return [
        (name, f"{name} is checkpointed: its image stays on {host.name}")
        for name in state.images_on(host)
    ]


def _record_nothing_moves(
    state: MasterState, host: Host, what: str, reasons: list[tuple[str, str]], now: float
) -> None:
    why = "; ".join(_grouped(reasons)[:8]) or "it runs no process of this cluster"
    key = f"nothing_moves {what}"
    soon = now - host.recorded_at.get(key, -inf) < _RECORD_PERIOD
    if soon or host.blocked.get(what) == why:
        return
    host.recorded_at[key], host.blocked[what] = now, why
    state.record(
        now, EventKind.NOTHING_MOVES, f"nothing can leave {host.name}: {why}", host=host.name,
        facts={"cause": what},
    )  # fmt: skip
