"""Meter of a run, real or simulated, by the events and commands of the master's core."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from math import inf
from typing import Final

import numpy as np

from rosrm.core.master import events as happened
from rosrm.core.master.commands import Command
from rosrm.core.master.master_state import MasterState
from rosrm.core.master.state.host_arrays import FloatArray
from rosrm.core.master.state.hosts import HostCondition
from rosrm.core.master.state.process import Process, ProcessPhase
from rosrm.model.event_kinds import EventKind
from rosrm.model.records import Record
from rosrm.model.values import Kind
from rosrm.wording import standing

#: Resources with a balance that is measured and drawn.
MEASURED: Final = ("memory", "cpu")
#: Most samples of the curves; beyond it every other one is dropped.
_SAMPLES: Final = 4000
_ENDS: Final = frozenset({EventKind.FINISHED, EventKind.FAILED, EventKind.CANCELLED})
_CHANGES: Final = _ENDS | {
    EventKind.SUBMITTED, EventKind.ASSIGNED, EventKind.MIGRATION_BEGUN, EventKind.MIGRATED,
    EventKind.STAYED,
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class Curves:
    """The usage over time, in the master's view.

    Attributes:
        times: (T,) seconds from the first arrival; a value holds until the next time.
        hosts: names of the H hosts.
        usage: by resource, (T, H) fractions; NaN where a host was not there.
        limit: by resource, (H,) the newest limit of a host.
    """

    times: FloatArray
    hosts: tuple[str, ...]
    usage: Mapping[str, FloatArray]
    limit: Mapping[str, FloatArray]


@dataclass(frozen=True, slots=True)
class Outcome:
    """A run in numbers.

    Attributes:
        first: time of the first arrival, by the master's monotonic clock; 0: there was none.
        processes: submitted and accepted.
        finished, running, waiting, ended_otherwise: numbers by state at the end; they add up to
            `processes`. Waiting: in the queue, or set aside because no host may take it.
        never_placed: process name to the reason, of those that never got a host.
        makespan: seconds from the first arrival to the end of the last job; None: a job has not
            finished, or there is none.
        wait_mean, wait_max: seconds from arrival to the first host, of those that got one.
        migrations, failed_migrations: migrations that succeeded, and that did not.
        imbalance: by resource, fullest minus emptiest host, fraction, mean over time.
        over_limit: seconds that a host was at or over a limit, summed over the hosts.
        span: seconds over which the last two were measured.
        placements: process name to its hosts, in order.
        arrivals, ends: process name to seconds from the first arrival.
        events: number of events that the core processed.
    """

    first: float
    processes: int
    finished: int
    running: int
    waiting: int
    ended_otherwise: int
    never_placed: Mapping[str, str]
    makespan: float | None
    wait_mean: float
    wait_max: float
    migrations: int
    failed_migrations: int
    imbalance: Mapping[str, float]
    over_limit: float
    span: float
    placements: Mapping[str, tuple[str, ...]]
    arrivals: Mapping[str, float]
    ends: Mapping[str, float]
    curves: Curves
    events: int


@dataclass(slots=True)
class _Totals:
    """The sums over time since the first arrival."""

    seconds: float = 0.0
    gap: dict[str, float] = field(default_factory=lambda: dict.fromkeys(MEASURED, 0.0))
    over: float = 0.0

    def copy(self) -> _Totals:
        return _Totals(self.seconds, dict(self.gap), self.over)


class Meter:
    """A measurement that follows a run.

    Args:
        until: the run is measured up to here; inf: up to the last change.
    """

    def __init__(self, until: float = inf) -> None:
        self._until = until
        self.events = 0
        self._first = inf
        self._arrivals: dict[str, float] = {}
        self._placed: dict[str, list[str]] = {}
        self._placed_at: dict[str, float] = {}
        self._ends: dict[str, float] = {}
        self._migrations = self._failed = 0
        self._at = 0.0
        self._gap = dict.fromkeys(MEASURED, 0.0)
        self._over = 0
        self._totals = _Totals()
        self._at_change = _Totals()
        self._samples: list[tuple[float, dict[str, FloatArray]]] = []
        self._every = 0.0
        self._limit = {name: np.zeros(0) for name in MEASURED}

    @property
    def ended(self) -> int:
        """Return the number of processes that have ended so far."""
        return len(self._ends)

    def begin(self, state: MasterState, now: float) -> None:
        """Begin with a core's state: unfinished processes arrive now, running ones have hosts."""
        for process in state.processes.values():
            if process.phase.is_terminal:
                continue
            self._first = now
            self._arrivals[process.name] = now
            owner = state.owner_of(process)
            if owner is not None:
                self._placed[process.name] = [owner.host.name]

    def take(
        self, state: MasterState, event: happened.Event, commands: Sequence[Command], now: float
    ) -> None:
        """Process an event of the core, with the commands that followed from it."""
        self.events += 1
        for command in commands:
            if isinstance(command, Record) and command.kind in _CHANGES:
                self._note(command, now)
        if isinstance(event, happened.ReadingsReceived):
            self._sample(state, now)

    def changed(self, now: float) -> None:
        """Note the time of a change that is not an event of the core."""
        self._integrate(now)
        self._at_change = self._totals.copy()

    def _note(self, record: Record, now: float) -> None:
        name = record.process
        if record.kind is EventKind.SUBMITTED:
            self._first = min(self._first, now)
            self._arrivals.setdefault(name, now)
        elif record.kind is EventKind.ASSIGNED:
            self._placed.setdefault(name, []).append(record.host)
            self._placed_at.setdefault(name, now)
            self._ends.pop(name, None)
        elif record.kind is EventKind.MIGRATED:
            self._migrations += 1
            self._placed.setdefault(name, []).append(record.host)
        elif record.kind is EventKind.STAYED:
            self._failed += 1
        elif record.kind in _ENDS:
            self._ends[name] = now
        self.changed(now)

    # --- usage over time -----------------------------------------------------------------

    def _integrate(self, now: float) -> None:
        """Add the time since the last sample, whose values hold until now."""
        seconds = min(now, self._until) - max(self._at, self._first)
        self._at = now
        if seconds <= 0.0 or seconds == inf:
            return
        totals = self._totals
        totals.seconds += seconds
        totals.over += seconds * self._over
        for name in MEASURED:
            totals.gap[name] += seconds * self._gap[name]

    def _sample(self, state: MasterState, now: float) -> None:
        self._integrate(now)
        table = state.hosts
        up = table.condition == HostCondition.UP
        self._over = int(((table.usage >= table.limit).any(axis=0) & up).sum())
        usage = {}
        for name in MEASURED:
            if name not in table.resources:
                usage[name] = np.full(len(table), np.nan)
                continue
            row = table.resources.index(name)
            values = np.where(up, table.usage[row], np.nan)
            usage[name] = values
            there = values[~np.isnan(values)]
            self._gap[name] = float(there.max() - there.min()) if len(there) else 0.0
            newest = np.ones(len(table))
            newest[: len(self._limit[name])] = self._limit[name]
            self._limit[name] = np.where(up, table.limit[row], newest)
        self._keep(now, usage)

    def _keep(self, now: float, usage: dict[str, FloatArray]) -> None:
        if self._samples and now - self._samples[-1][0] < self._every:
            return
        self._samples.append((now, usage))
        if len(self._samples) > _SAMPLES:
            span = now - self._samples[0][0]
            self._samples = self._samples[::2]
            self._every = max(2.0 * self._every, 2.0 * span / _SAMPLES)

    # --- the end -------------------------------------------------------------------------

    def outcome(self, state: MasterState, now: float) -> Outcome:
        """Return all figures; `now` is the end of the run."""
        self._integrate(now)
        if self._samples and now > self._samples[-1][0]:
            self._samples.append((now, self._samples[-1][1]))  # the last sample still holds
        totals = self._totals if self._until < inf else self._at_change
        first = 0.0 if self._first == inf else self._first
        waits = [at - self._arrivals.get(name, at) for name, at in self._placed_at.items()]
        phases = [process.phase for process in state.processes.values()]
        over = sum(phase.is_terminal for phase in phases)
        finished = sum(phase is ProcessPhase.FINISHED for phase in phases)
        waiting = (ProcessPhase.QUEUED, ProcessPhase.SET_ASIDE, ProcessPhase.SCHEDULED)
        never = {
            name: _why_not_placed(state, process)
            for name, process in state.processes.items()
            if name not in self._placed
        }
        seconds = totals.seconds or 1.0
        return Outcome(
            first=first, processes=len(phases), finished=finished,
            running=sum(phase not in waiting and not phase.is_terminal for phase in phases),
            waiting=sum(phase in waiting for phase in phases),
            ended_otherwise=over - finished,
            never_placed=never,
            makespan=self._makespan(state, first),
            wait_mean=float(np.mean(waits)) if waits else 0.0,
            wait_max=max(waits, default=0.0),
            migrations=self._migrations, failed_migrations=self._failed,
            imbalance={name: gap / seconds for name, gap in totals.gap.items()},
            over_limit=totals.over, span=totals.seconds,
            placements={name: tuple(hosts) for name, hosts in self._placed.items()},
            arrivals={name: at - first for name, at in self._arrivals.items()},
            ends={name: at - first for name, at in self._ends.items()},
            curves=self._curves(state, first), events=self.events,
        )  # fmt: skip

    def _makespan(self, state: MasterState, first: float) -> float | None:
        jobs = [one for one in state.processes.values() if one.spec.kind is Kind.JOB]
        if not jobs or any(job.phase is not ProcessPhase.FINISHED for job in jobs):
            return None
        return max(self._ends.get(job.name, first) for job in jobs) - first

    def _curves(self, state: MasterState, first: float) -> Curves:
        hosts = tuple(host.name for host in state.hosts.hosts)
        times = np.array([at - first for at, _ in self._samples])
        usage, limit = {}, {}
        for name in MEASURED:
            whole = np.full((len(self._samples), len(hosts)), np.nan)
            for row, (_, values) in enumerate(self._samples):
                whole[row, : len(values[name])] = values[name]
            usage[name] = whole
            limit[name] = np.ones(len(hosts))
            limit[name][: len(self._limit[name])] = self._limit[name]
        return Curves(times, hosts, usage, limit)


def _why_not_placed(state: MasterState, process: Process) -> str:
    """Return the reason why a process got no host; one cancelled before may have none."""
    if process.phase.is_terminal:
        return process.reason or f"it {standing(process.phase.value)}"
    return process.reason or f"it waits behind {state.queue.head()}"
