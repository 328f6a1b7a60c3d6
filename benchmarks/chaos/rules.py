"""Rules for the runs of a process, with allowances by harm. Pure; imports nothing from rosrm."""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Final

from benchmarks.chaos.excuses import (
    LAST_CYCLES,
    MEETING,
    OVERLOAD,
    STARTING,
    Harm,
    Promise,
    is_struck,
    may_be_lost,
    may_end,
    most_behind,
    unkept,
)
from benchmarks.chaos.outputs import Run

#: Seconds after the hosts concerned reach the master again in which there may be two owners.
_OVERLAP: Final = 1.0
#: Seconds by which lines of two processes may cross without both having been active at once.
_CROSSING: Final = 0.05


@dataclass(frozen=True)
class Violation:
    """A promise that was not kept."""

    kind: str
    name: str
    text: str


@dataclass
class Judgement:
    """The result of judging the past.

    Attributes:
        violations: broken promises.
        allowed: how often each allowance applied, by title.
        parted: seconds for which a former owner was active after the partition was healed.
    """

    violations: list[Violation] = field(default_factory=list)
    allowed: Counter[str] = field(default_factory=Counter)
    parted: list[float] = field(default_factory=list)

    def add(self, other: Judgement) -> None:
        """Add another judgement to this one."""
        self.violations += other.violations
        self.allowed += other.allowed
        self.parted += other.parted


def chain(runs: Iterable[Run]) -> list[Run]:
    """Return the runs of one process that were active, in the order of their last "active"."""
    return sorted((run for run in runs if run.first), key=lambda run: run.last)


def judge_service(
    name: str, promise: Promise, chained: Sequence[Run], harms: Sequence[Harm],
    reached: Mapping[str, float] = MappingProxyType({}),
) -> Judgement:  # fmt: skip
    """Judge the runs of a service.

    Args:
        name: of the service.
        promise: that was given.
        chained: its runs, as returned by `chain`.
        harms: that were done in that time.
        reached: by host, the time at which it had received an order from the master again.
    """
    judged = Judgement(
        [
            Violation("state", name, f"{name} went back within one run: {run}")
            for run in chained
            if run.backwards
        ]
    )
    for index, (one, following) in enumerate(itertools.pairwise(chained)):
        for other in chained[index + 1 :]:
            if _overlap(one, other) > _CROSSING:
                judged.add(_judge_overlap(name, promise, one, other, harms, reached))
        if not may_end(name, promise, one, harms):
            text = f"{name}: {one} ended, and nothing was done to it; then came {following}"
            judged.violations.append(Violation("touched", name, text))
        if promise.stateful:
            judged.add(_judge_state(name, promise, one, following, harms))
    return judged


def _overlap(one: Run, other: Run) -> float:
    """Return the seconds for which both were active; `one` ended first."""
    return one.last - max(one.first, other.first)


def _judge_overlap(
    name: str, promise: Promise, one: Run, other: Run, harms: Sequence[Harm],
    reached: Mapping[str, float],
) -> Judgement:  # fmt: skip
    """Judge two runs active at once: allowed in a relaunch migration, and in a partition."""
    if any(harm.kind == "overlap" and harm.process == name for harm in harms):
        return Judgement(allowed=Counter(overlaps=1))
    parting = [
        harm
        for harm in harms
        if harm.hides and (harm.concerns(one.host) or harm.concerns(other.host))
    ]
    # A fault explains it, or else an overload, which may last to the end.
    parting = [harm for harm in parting if harm.kind != OVERLOAD] or parting
    until = [harm.ended + _OVERLAP + (STARTING if harm.restarts else MEETING) for harm in parting]
    # On a busy machine a restarted part comes up late; the first order that it received tells when.
    until += [reached[host] + _OVERLAP for host in (one.host, other.host) if host in reached]
    parted = promise.elsewhere and not promise.isolated
    if parted and parting and one.last <= max(until):
        healed = max(harm.ended for harm in parting)
        return Judgement(allowed=Counter(partitioned=1), parted=[max(0.0, one.last - healed)])
    text = f"{name}: both active for {_overlap(one, other):.2f} s: {one} and {other}"
    return Judgement([Violation("doubled", name, text)])


def _judge_state(
    name: str, promise: Promise, one: Run, following: Run, harms: Sequence[Harm]
) -> Judgement:
    """Judge the continuity of the numbers; a deviation gets the title of its allowance."""
    behind = one.last_number + 1 - following.first_number
    if behind == 0:
        return Judgement()
    if behind > 0 and is_struck(name, promise, one, harms):
        if behind <= LAST_CYCLES:
            return Judgement(allowed=Counter(state_cycles_repeated=1))
        if behind <= most_behind(name, promise, one, following, harms):
            return Judgement(allowed=Counter(state_seconds_repeated=1))
        if following.first_number == 1 and may_be_lost(promise, one, following, harms):
            return Judgement(allowed=Counter(state_from_nothing=1))
        if behind <= unkept(one, following, harms):
            return Judgement(allowed=Counter(state_older_disk_full=1))
    text = f"{name}: {following.first_number} after {one.last_number}: {one}, then {following}"
    return Judgement([Violation("state", name, text)])


def judge_job(name: str, accepted: float, runs: Sequence[Run], harms: Sequence[Harm]) -> Judgement:
    """Judge a job: it runs at least once, and more than once only where its host was struck."""
    if len(runs) <= 1:
        return Judgement()
    hosts = {run.host for run in runs}
    excused = any(
        harm.ended >= accepted
        and (
            harm.process == name
            or ((harm.kills or harm.forgets) and any(harm.concerns(one) for one in hosts))
        )
        for harm in harms
    )
    if excused:
        return Judgement(allowed=Counter(jobs_repeated=1))
    text = f"the job {name} ran {len(runs)} times: {'; '.join(map(str, runs))}"
    return Judgement([Violation("repeated", name, text)])


def judge_line(line: Mapping[str, Sequence[Run]]) -> list[Violation]:
    """Return a violation for each job of the line that began before an earlier one."""
    begun = [(name, runs[0].born) for name, runs in line.items() if runs]
    return [
        Violation("order", later, f"{later} began at {then:.2f}, before {earlier} at {when:.2f}")
        for (earlier, when), (later, then) in itertools.pairwise(begun)
        if then < when
    ]
