"""Rules for the runs of a process, with their allowances. Pure; imports nothing from rosrm."""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Final

from benchmarks.chaos.allowances import (
    LAST_CYCLES,
    MEETING,
    OVERLOAD,
    STARTING,
    Disturbance,
    Guarantees,
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
    """A guarantee that was not kept."""

    kind: str
    name: str
    text: str


@dataclass
class Judgement:
    """The result of judging the past.

    Attributes:
        violations: broken guarantees.
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
    name: str, guarantees: Guarantees, chained: Sequence[Run], disturbances: Sequence[Disturbance],
    reached: Mapping[str, float] = MappingProxyType({}),
) -> Judgement:  # fmt: skip
    """Judge the runs of a service.

    Args:
        name: of the service.
        guarantees: of the service.
        chained: its runs, as returned by `chain`.
        disturbances: in that time.
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
        relevant = [
            disturbance
            for disturbance in disturbances
            if disturbance.instance in ("", one.instance)
        ]
        for other in chained[index + 1 :]:
            if _overlap(one, other) > _CROSSING:
                judged.add(_judge_overlap(name, guarantees, one, other, disturbances, reached))
        if not may_end(name, guarantees, one, relevant):
            text = f"{name}: {one} ended, and nothing was done to it; then came {following}"
            judged.violations.append(Violation("touched", name, text))
        if guarantees.stateful:
            judged.add(_judge_state(name, guarantees, chained[: index + 2], relevant))
    return judged


def _overlap(one: Run, other: Run) -> float:
    """Return the seconds for which both were active; `one` ended first."""
    return one.last - max(one.first, other.first)


def _judge_overlap(
    name: str, guarantees: Guarantees, one: Run, other: Run, disturbances: Sequence[Disturbance],
    reached: Mapping[str, float],
) -> Judgement:  # fmt: skip
    """Judge two runs active at once: allowed in a relaunch migration, and in a partition."""
    if any(
        disturbance.kind == "overlap" and disturbance.process == name
        for disturbance in disturbances
    ):
        return Judgement(allowed=Counter(overlaps=1))
    parting = [
        disturbance
        for disturbance in disturbances
        if disturbance.hides
        and not disturbance.instance
        and (disturbance.concerns(one.host) or disturbance.concerns(other.host))
    ]
    # A fault explains it, or else an overload, which may last to the end.
    parting = [disturbance for disturbance in parting if disturbance.kind != OVERLOAD] or parting
    until = [
        disturbance.ended + _OVERLAP + (STARTING if disturbance.restarts else MEETING)
        for disturbance in parting
    ]
    # On a busy machine a restarted part comes up late; its first received order shows when.
    until += [reached[host] + _OVERLAP for host in (one.host, other.host) if host in reached]
    parted = guarantees.elsewhere and not guarantees.isolated
    if parted and parting and one.last <= max(until):
        healed = max(disturbance.ended for disturbance in parting)
        return Judgement(allowed=Counter(partitioned=1), parted=[max(0.0, one.last - healed)])
    text = f"{name}: both active for {_overlap(one, other):.2f} s: {one} and {other}"
    return Judgement([Violation("doubled", name, text)])


def _judge_state(
    name: str, guarantees: Guarantees, chained: Sequence[Run], disturbances: Sequence[Disturbance]
) -> Judgement:
    """Judge the continuity of the last two runs; a deviation gets the title of its allowance."""
    *earlier, one, following = chained
    behind = one.last_number + 1 - following.first_number
    if behind == 0:
        return Judgement()
    if behind > 0 and is_struck(name, guarantees, one, disturbances):
        if behind <= LAST_CYCLES:
            return Judgement(allowed=Counter(state_cycles_repeated=1))
        if behind <= most_behind(name, guarantees, one, following, disturbances):
            return Judgement(allowed=Counter(state_seconds_repeated=1))
        if following.first_number == 1 and may_be_lost(guarantees, one, following, disturbances):
            return Judgement(allowed=Counter(state_from_nothing=1))
        if behind <= unkept(one, following, disturbances):
            return Judgement(allowed=Counter(state_older_disk_full=1))
    # The state of `one` is out of reach, and an earlier instance had run on beside it.
    if (
        any(run.first_number <= following.first_number <= run.last_number + 1 for run in earlier)
        and is_struck(name, guarantees, one, disturbances)
        and may_be_lost(guarantees, one, following, disturbances)
    ):
        return Judgement(allowed=Counter(state_of_an_earlier_instance=1))
    text = f"{name}: {following.first_number} after {one.last_number}: {one}, then {following}"
    return Judgement([Violation("state", name, text)])


def judge_versions(
    name: str, chained: Sequence[Run], former: int, newest: int, *, may_return: bool
) -> list[Violation]:
    """Return a violation if a process of an application has run other versions than requested.

    Args:
        former: that ran before.
        newest: that was requested.
        may_return: the application has returned, so that `former` may follow `newest`.
    """
    versions = [run.version for run in chained]
    if {*versions} <= {former, newest} and (may_return or versions == sorted(versions)):
        return []
    text = f"{name}: version {newest} was to follow {former}: {'; '.join(map(str, chained))}"
    return [Violation("versions", name, text)]


def judge_job(
    name: str, accepted: float, runs: Sequence[Run], disturbances: Sequence[Disturbance]
) -> Judgement:
    """Judge a job: it runs at least once, and more than once only where its host was struck."""
    if len(runs) <= 1:
        return Judgement()
    hosts = {run.host for run in runs}
    excused = any(
        disturbance.ended >= accepted
        and (
            disturbance.process == name
            or (
                (disturbance.kills or disturbance.forgets)
                and any(disturbance.concerns(one) for one in hosts)
            )
        )
        for disturbance in disturbances
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
