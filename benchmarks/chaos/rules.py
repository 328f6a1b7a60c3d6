"""What the runs of a process must be like, and which harm excuses what. Pure.

Knows nothing of rosrm; what is promised for which fault stands here.
"""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Final

from benchmarks.chaos.outputs import Run

#: Seconds after the hosts concerned reach the master again in which there may be two owners.
_OVERLAP: Final = 1.0
#: Seconds for the parts to hear each other once nothing keeps them from it: discovery, by DDS.
_MEETING: Final = 3.0
#: The same where a part was started again: it has to come up before.
_STARTING: Final = 8.0
#: Seconds by which lines of two processes may cross without both having been active at once.
_CROSSING: Final = 0.05
#: Cycles that are repeated by who follows one that was killed: the one under way, and one before.
_LAST_CYCLES: Final = 2
#: The same where the machine is busy: what is kept is a second behind at most, ten cycles.
_LAST_SECOND: Final = 12
#: Seconds after which a state has come to another host.
_YOUNG: Final = 6.0
#: What is asked for, and ends or silences nobody by force.
MOVES: Final = ("move", "overlap")
#: The kind of the harm that other programs on the machine do.
OVERLOAD: Final = "overload"
#: Cycles a second.
_RATE: Final = 10.0


@dataclass(frozen=True)
class Promise:
    """What holds of a service.

    Attributes:
        members: processes of one instance.
        stateful: its numbers go on.
        standby: it has a second instance, silent.
        elsewhere: it goes to another host when its own is lost.
        isolated: its host stops it when it is cut off.
        kept: its state is kept on its own host, on the disk.
        copied: cycles by which a copy of its state on another host may be behind; 0: there is none.
    """

    members: int = 1
    stateful: bool = False
    standby: bool = False
    elsewhere: bool = False
    isolated: bool = False
    kept: bool = False
    copied: int = 0


@dataclass(frozen=True)
class Harm:
    """Something that was done to the lab, or asked for, and what it may explain.

    Attributes:
        kind: of the fault; or "move", "overlap" (a move during which both may be active).
        hosts: that were concerned; "*": all of them.
        process: that was struck or moved; "": none by itself.
        begun, ended: monotonic time.
        kills: what runs on the hosts ends.
        hides: the hosts and the master do not hear each other.
        restarts: a part had to be started again.
        forgets: how a job ended there meanwhile is not known.
        fills: nothing more could be kept on the disk there.
        deafens: who fences there did not hear that the master hears the host.
    """

    kind: str
    begun: float
    ended: float
    hosts: frozenset[str] = frozenset()
    process: str = ""
    kills: bool = False
    hides: bool = False
    restarts: bool = False
    forgets: bool = False
    fills: bool = False
    deafens: bool = False

    def concerns(self, host: str) -> bool:
        """Whether it was done to a host."""
        return host in self.hosts or "*" in self.hosts


@dataclass(frozen=True)
class Violation:
    """A promise that was not kept."""

    kind: str
    name: str
    text: str


@dataclass
class Judgement:
    """What came of looking back.

    Attributes:
        violations: what was not as promised.
        allowed: how often something happened that is, by title.
        parted: seconds for which a former owner went on, after what had parted it from the master.
    """

    violations: list[Violation] = field(default_factory=list)
    allowed: Counter[str] = field(default_factory=Counter)
    parted: list[float] = field(default_factory=list)

    def add(self, other: Judgement) -> None:
        """Take in another one."""
        self.violations += other.violations
        self.allowed += other.allowed
        self.parted += other.parted


def chain(runs: Iterable[Run]) -> list[Run]:
    """The runs of one process that were active, in the order in which they ended to be."""
    return sorted((run for run in runs if run.first), key=lambda run: run.last)


def judge_service(
    name: str, promise: Promise, chained: Sequence[Run], harms: Sequence[Harm],
    reached: Mapping[str, float] = MappingProxyType({}),
) -> Judgement:  # fmt: skip
    """Look back at the runs of a service.

    Args:
        name: of the service.
        promise: that was given.
        chained: its runs, as `chain` has them.
        harms: that were done meanwhile.
        reached: when a host is known to have taken an order from the master again.
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
        if not _may_end(name, promise, one, harms):
            text = f"{name}: {one} ended, and nothing was done to it; then came {following}"
            judged.violations.append(Violation("touched", name, text))
        if promise.stateful:
            judged.add(_judge_state(name, promise, one, following, harms))
    return judged


def _may_end(name: str, promise: Promise, run: Run, harms: Sequence[Harm]) -> bool:
    return any(
        harm.process == name
        or (harm.kills and harm.concerns(run.host))
        or ((promise.elsewhere or promise.isolated) and harm.hides and harm.concerns(run.host))
        or ((promise.elsewhere or promise.isolated) and harm.deafens and harm.concerns(run.host))
        for harm in harms
    )


def _overlap(one: Run, other: Run) -> float:
    """Seconds for which both were active; `one` ended first."""
    return one.last - max(one.first, other.first)


def _judge_overlap(
    name: str, promise: Promise, one: Run, other: Run, harms: Sequence[Harm],
    reached: Mapping[str, float],
) -> Judgement:  # fmt: skip
    """Two that were active at once: by a move that allows it, or while they were parted."""
    if any(harm.kind == "overlap" and harm.process == name for harm in harms):
        return Judgement(allowed=Counter(overlaps=1))
    parting = [
        harm
        for harm in harms
        if harm.hides and (harm.concerns(one.host) or harm.concerns(other.host))
    ]
    # What was done explains it, or else the machine itself, which may be busy to the end.
    parting = [harm for harm in parting if harm.kind != OVERLOAD] or parting
    until = [harm.ended + _OVERLAP + (_STARTING if harm.restarts else _MEETING) for harm in parting]
    # On a busy machine a part that was started again comes up late: what it took shows that it has.
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
    """Whether the numbers went on; where they did not, a title for what is allowed."""
    behind = one.last_number + 1 - following.first_number
    if behind == 0:
        return Judgement()
    if behind > 0 and _struck(name, promise, one, harms):
        if behind <= _LAST_CYCLES:
            return Judgement(allowed=Counter(state_cycles_repeated=1))
        if behind <= _most_behind(name, promise, one, following, harms):
            return Judgement(allowed=Counter(state_seconds_repeated=1))
        if following.first_number == 1 and _may_be_lost(name, promise, one, following, harms):
            return Judgement(allowed=Counter(state_from_nothing=1))
        if any(harm.fills for harm in harms):
            return Judgement(allowed=Counter(state_older_disk_full=1))
    text = f"{name}: {following.first_number} after {one.last_number}: {one}, then {following}"
    return Judgement([Violation("state", name, text)])


def _struck(name: str, promise: Promise, run: Run, harms: Sequence[Harm]) -> bool:
    """Whether it ended by force, and not by a move."""
    return any(
        (harm.process == name and harm.kind not in MOVES)
        or (harm.kills and harm.concerns(run.host))
        or ((promise.elsewhere or promise.isolated) and harm.hides and harm.concerns(run.host))
        for harm in harms
    )


def _most_behind(
    name: str, promise: Promise, one: Run, following: Run, harms: Sequence[Harm]
) -> float:
    """Cycles that may be repeated by who follows one that was struck."""
    if following.host == one.host and promise.kept:
        return _LAST_SECOND
    # For a move the standby makes room; where that fails, the copy is what is left.
    asked = any(harm.kind in MOVES and harm.process == name for harm in harms)
    second = asked or _is_struck_twice(name, promise, harms)
    if promise.standby and not (second and promise.copied):
        return _LAST_CYCLES + _unseen(one, harms, one.host)
    # A young one's copy may be of the one that it followed, as young or on its way then.
    young = _RATE * 2 * _YOUNG if one.last - one.first < _YOUNG else 0.0
    return promise.copied + young + _unseen(one, harms) if promise.copied else 0.0


def _is_struck_twice(name: str, promise: Promise, harms: Sequence[Harm]) -> bool:
    """Whether who was to go on, or what it was to go on from, may have been struck as well."""
    blows = [
        harm
        for harm in harms
        if harm.hides or harm.kills or harm.deafens or harm.fills
        or (harm.process == name and harm.kind not in MOVES)
    ]  # fmt: skip
    # What stops at once wherever the master is not heard, its standby included.
    everywhere = promise.isolated and any("*" in harm.hosts for harm in blows)
    return len(blows) > 1 or everywhere


def _unseen(run: Run, harms: Sequence[Harm], host: str = "") -> float:
    """Cycles of a run that nobody could see: one of them was cut off, and it went on.

    Args:
        host: that was cut off; "": any, for the copies lie on any.
    """
    since = [harm.begun for harm in harms if harm.hides and (not host or harm.concerns(host))]
    return _RATE * max(0.0, run.last - min(since)) if since else 0.0


def _may_be_lost(
    name: str, promise: Promise, one: Run, following: Run, harms: Sequence[Harm]
) -> bool:
    """Whether there may be nothing to go on from: no copy, none yet, or none within reach."""
    if following.host == one.host:
        return not promise.kept
    if _is_struck_twice(name, promise, harms) or one.last - one.first < _YOUNG:
        return True
    return not (promise.standby or promise.copied)


def judge_job(name: str, accepted: float, runs: Sequence[Run], harms: Sequence[Harm]) -> Judgement:
    """Done at least once; begun more than once only where something was done to its host."""
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
    """Those who wait in line are begun in the order in which they came."""
    begun = [(name, runs[0].born) for name, runs in line.items() if runs]
    return [
        Violation("order", later, f"{later} began at {then:.2f}, before {earlier} at {when:.2f}")
        for (earlier, when), (later, then) in itertools.pairwise(begun)
        if then < when
    ]
