"""Rebalancing: processes move from the most loaded hosts to others, to even out their loads.

The *load* of a host is the largest of its usages, with reservations, as fractions of their limits.
The *spread* is the difference between the largest and the smallest load of all hosts that take
work. Each move lowers the larger load of its two hosts, so that no process moves back.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from math import inf
from typing import Final

import numpy as np

from rosrm.core.master.assignment.neighbours import running_with
from rosrm.core.master.master_state import MasterState
from rosrm.core.master.migration.eviction import PlannedMoves, begin_moves, plan_moves
from rosrm.core.master.migration.room import is_leaving, share_of, trial, why_it_cannot_move
from rosrm.core.master.migration.start import may_begin, moves_under_way
from rosrm.core.master.outcomes import Rejected
from rosrm.core.master.state.host_arrays import BoolArray, FloatArray
from rosrm.core.master.state.hosts import Host, HostCondition
from rosrm.core.master.state.process import Process
from rosrm.model.event_kinds import EventKind
from rosrm.wording import few, listed

#: Least difference by which a move lowers the larger load of its two hosts.
_LEAST_GAIN: Final = 0.05
#: Most loaded hosts, of which a plan looks for a process to move.
_MOST_SOURCES: Final = 4
#: Most reasons against processes in one answer.
_MOST_REASONS: Final = 3
_CAUSE: Final = "the load of the hosts is evened out"


@dataclass(frozen=True, slots=True)
class Shift:
    """One move of a plan: the process with those that move along, and the loads of both hosts."""

    planned: PlannedMoves
    source: Host
    before: tuple[float, float]
    after: tuple[float, float]

    @property
    def names(self) -> list[str]:
        """Return the names of the processes that move."""
        return [process.name for process, *_ in self.planned.steps]

    def __str__(self) -> str:
        here, there = self.source.name, self.planned.destination.name
        (a, b), (a_after, b_after) = self.before, self.after
        return (
            f"{listed(self.names)} from {here} ({a:.0%} loaded, then {a_after:.0%}) to {there} "
            f"({b:.0%}, then {b_after:.0%})"
        )


@dataclass(slots=True)
class Round:
    """The moves of one round.

    Attributes:
        spread: a sentence on the loads before.
        freed: (R, H) fractions that the moves free on their sources.
        against: reasons why further processes stay.
    """

    spread: str
    freed: FloatArray
    shifts: list[Shift] = field(default_factory=list)
    against: list[str] = field(default_factory=list)

    @property
    def moving(self) -> set[str]:
        """Return the names of the processes that move."""
        return {name for one in self.shifts for name in one.names}

    def __str__(self) -> str:
        """Return the round as text, one line for each move."""
        if self.shifts:
            return "\n".join([self.spread, *(f"move {one}" for one in self.shifts)])
        why = "; ".join(few(dict.fromkeys(self.against), _MOST_REASONS))
        return f"{self.spread}\nnothing moves: {why or 'no move would even that out'}"


def review_rebalancing(state: MasterState, now: float) -> None:
    """Begin the pending moves of a round; begin a round if the hosts are uneven for long enough."""
    current = state.rebalancing
    if current.pending:
        _begin_pending(state, now)
    elif state.settings.rebalance and _is_due(state, now):
        current.due = now + state.settings.rebalance_after
        planned = plan_round(state, now)
        if planned.shifts:
            begin_round(state, planned, now)


def _is_due(state: MasterState, now: float) -> bool:
    """Return True if the spread exceeds its threshold for long enough, and nothing moves."""
    current, settings = state.rebalancing, state.settings
    loads = _loads(state, np.zeros_like(state.hosts.busy))[_takes_work(state)]
    if len(loads) < 2 or float(np.ptp(loads)) <= settings.rebalance_spread:
        current.uneven_since = inf
        return False
    current.uneven_since = min(current.uneven_since, now)
    joined = now - current.joined_at < settings.rebalance_after
    lasts = settings.hysteresis if joined else settings.rebalance_after
    long_enough = now - max(current.uneven_since, current.joined_at) >= lasts
    return long_enough and now >= current.due and moves_under_way(state) == 0


def begin_round(state: MasterState, planned: Round, now: float) -> None:
    """Begin the moves of a round, `max_migrations` at a time."""
    state.record(
        now, EventKind.REBALANCING, f"the hosts are rebalanced: {planned}",
        facts={"moves": [[*one.names, one.planned.destination.name] for one in planned.shifts]},
    )  # fmt: skip
    state.rebalancing.pending += [
        (one.names[0], one.planned.destination.name) for one in planned.shifts
    ]
    _begin_pending(state, now)


def _begin_pending(state: MasterState, now: float) -> None:
    pending = state.rebalancing.pending
    while pending and moves_under_way(state) < state.settings.max_migrations:
        name, destination = pending[0]
        process, host = state.processes.get(name), state.hosts.by_name[destination]
        if process is not None and not may_begin(state, 1 + len(running_with(state, process))):
            return
        del pending[0]
        if process is None or process.phase.is_terminal:
            continue
        planned = _plan_again(state, process, host, now)
        if isinstance(planned, Rejected):
            message = f"{name} is not moved: {planned.reason}"
            state.record(now, EventKind.MIGRATION_REFUSED, message, process=name)
        else:
            begin_moves(state, planned, now)


def _plan_again(
    state: MasterState, process: Process, host: Host, now: float
) -> PlannedMoves | Rejected:
    """Return the move of a round that could not begin at once, unless it gains nothing any more."""
    planned = _plan(state, process, now, host)
    if isinstance(planned, Rejected):
        return planned
    source = state.instances[process.owner].host
    if _gains(_shift(state, planned, source, np.zeros_like(state.hosts.busy))):
        return planned
    return Rejected(
        f"its move would not even out the load of {source.name} and {host.name} any more"
    )


# --- the plan ---------------------------------------------------------------------------------


def plan_round(state: MasterState, now: float) -> Round:
    """Return the moves of one round; nothing begins."""
    freed, most = np.zeros_like(state.hosts.busy), state.settings.rebalance_moves
    planned = Round(_spread_text(state, freed), freed)
    with trial(state) as tried:
        while len(planned.moving) < most:
            shift = _best_shift(state, planned, now)
            if shift is None or len(planned.moving) + len(shift.names) > most:
                break
            for process, *_ in shift.planned.steps:
                freed[:, shift.source.column] += share_of(state, state.instances[process.owner])
            tried.reserve(shift.planned)
            planned.shifts.append(shift)
    return planned


def _takes_work(state: MasterState) -> BoolArray:
    """Return the mask, (H,), of the hosts whose loads count."""
    table = state.hosts
    is_up = (table.condition == HostCondition.UP) & ~table.closed & ~table.report_due
    return np.asarray(is_up & (table.stale == 0) & ~table.without_reading())


def _loads(state: MasterState, freed: FloatArray) -> FloatArray:
    """Return the load, (H,), of each host without what planned moves free on it, (R, H)."""
    table = state.hosts
    is_limited = (table.limit > 0.0) & (table.limit < 1.0)
    used = np.zeros_like(table.busy)
    np.divide(table.busy - freed, table.limit, out=used, where=is_limited)
    loads: FloatArray = np.nan_to_num(used).max(axis=0, initial=0.0)
    return loads


def _spread_text(state: MasterState, freed: FloatArray) -> str:
    columns = np.flatnonzero(_takes_work(state))
    loads = _loads(state, freed)
    if len(columns) < 2:
        return "fewer than two hosts take work"
    low, high = columns[loads[columns].argmin()], columns[loads[columns].argmax()]
    names = [f"{state.hosts.hosts[at].name} ({loads[at]:.0%})" for at in (high, low)]
    return f"the loads of {names[0]} and {names[1]} differ most, by {loads[high] - loads[low]:.0%}"


def _best_shift(state: MasterState, planned: Round, now: float) -> Shift | None:
    """Return the move with the lowest larger load of its hosts; None: no move gains enough."""
    loads = _loads(state, planned.freed)
    columns = sorted(np.flatnonzero(_takes_work(state)), key=lambda at: -loads[at])
    for column in columns[:_MOST_SOURCES]:
        shifts = list(_shifts_from(state, state.hosts.hosts[column], planned, now))
        if shifts:
            return min(shifts, key=lambda one: max(one.after))
    return None


def _shifts_from(state: MasterState, source: Host, planned: Round, now: float) -> Iterator[Shift]:
    """Yield each further move from a host that gains enough."""
    for instance in state.instances_of(source):
        process = state.owned_by(instance)
        if process is None or process.name in planned.moving or is_leaving(state, instance):
            continue
        moves = _plan(state, process, now)
        if isinstance(moves, Rejected):
            planned.against.append(moves.reason)
            continue
        shift = _shift(state, moves, source, planned.freed)
        if _gains(shift):
            yield shift


def _gains(shift: Shift) -> bool:
    """Return True if both hosts of a move are then less loaded than its source was before."""
    return max(shift.after) <= shift.before[0] - _LEAST_GAIN


def _plan(
    state: MasterState, process: Process, now: float, host: Host | None = None
) -> PlannedMoves | Rejected:
    """Plan the move of a process to the best host, or to a given one."""
    for one in (process, *running_with(state, process)):
        why = _why_it_stays(state, one, now)
        if why:
            return Rejected(why)
    headroom = state.settings.headroom
    return plan_moves(state, process, _CAUSE, now, headroom=headroom, host=host)


def _shift(state: MasterState, planned: PlannedMoves, source: Host, freed: FloatArray) -> Shift:
    """Return planned moves with the loads of their hosts before and after.

    The same usage is subtracted at the source and added at the destination, whichever need has
    chosen the destination. Otherwise a process could move back at the same load.
    """
    here, there = columns = [source.column, planned.destination.column]
    capacity, then = state.hosts.capacity, freed.copy()
    for process, *_ in planned.steps:
        share = share_of(state, state.instances[process.owner])
        then[:, here] += share
        then[:, there] -= np.nan_to_num(share * capacity[:, here] / capacity[:, there])
    before, after = _loads(state, freed)[columns].tolist(), _loads(state, then)[columns].tolist()
    return Shift(planned, source, (before[0], before[1]), (after[0], after[1]))


def _why_it_stays(state: MasterState, process: Process, now: float) -> str:
    if process.spec.protect:
        return f"{process.name} is protected"
    return why_it_cannot_move(state, process, now)
