"""What is promised of a process, and which harm excuses what. Pure; knows nothing of rosrm."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Final

from benchmarks.chaos.outputs import Run

#: Seconds for the parts to hear each other once nothing keeps them from it: discovery, by DDS.
MEETING: Final = 3.0
#: The same where a part was started again: it has to come up before.
STARTING: Final = 8.0
#: Cycles that are repeated by who follows one that was killed: the one under way, and one before.
LAST_CYCLES: Final = 2
#: The same where the machine is busy: what is kept is a second behind at most, ten cycles.
_LAST_SECOND: Final = 12
#: Seconds of silence after which a host may have stopped what it is to stop when it is cut off:
#: 1.425 s by its fence (lease 3 s, suspect 1 s), less a beat (0.2 s) before and one after, and the
#: same once more for a busy machine, which takes the words late.
_FENCED: Final = 0.8
#: Seconds of silence after which a host may be lost: the lease, less a second to be heard again in.
_LOST: Final = 2.0
#: Seconds from the last "active" of a process that is being ended until it has ended.
_ENDING: Final = 0.5
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
        deafens: who fences there did not hear that the slave is at work, or the master hears it.
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


def may_end(name: str, promise: Promise, run: Run, harms: Sequence[Harm]) -> bool:
    """Whether a run of a process may end by what was done, or asked for."""
    return any(
        harm.process == name or (harm.kills and harm.concerns(run.host)) for harm in harms
    ) or _is_parted(promise, run, harms)


def _is_parted(promise: Promise, run: Run, harms: Sequence[Harm]) -> bool:
    """Whether its host, or the master, may have ended it for a silence that was long enough."""
    if not (promise.elsewhere or promise.isolated):
        return False
    until = run.last + _ENDING
    here = [harm for harm in harms if harm.concerns(run.host)]
    hidden = _silence([harm for harm in here if harm.hides], until)
    deaf = _silence([harm for harm in here if harm.deafens], until)
    # What goes on in a cut is stopped by its host only where that cannot know of its own slave.
    return deaf >= _FENCED or hidden >= (_FENCED if promise.isolated else _LOST)


def _silence(harms: Iterable[Harm], until: float) -> float:
    """Seconds for which at least one of them went on, until a moment; those in a row add up.

    A part that had to be started again says nothing until it is up.
    """
    silent, covered = 0.0, 0.0
    for harm in sorted(harms, key=lambda one: one.begun):
        begun = max(harm.begun, covered)
        ended = min(harm.ended + (STARTING if harm.restarts else 0.0), until)
        silent += max(0.0, ended - begun)
        covered = max(covered, ended)
    return silent


def is_struck(name: str, promise: Promise, run: Run, harms: Sequence[Harm]) -> bool:
    """Whether it ended by force, and not by a move."""
    return any(
        (harm.process == name and harm.kind not in MOVES)
        or (harm.kills and harm.concerns(run.host))
        for harm in harms
    ) or _is_parted(promise, run, harms)


def unkept(one: Run, following: Run, harms: Sequence[Harm]) -> float:
    """Cycles since the disk was full from which the successor went on; 0: it was not.

    On its own host it goes on from what that keeps; on another one from what any host keeps.
    """
    since = [
        harm.begun
        for harm in harms
        if harm.fills and (following.host != one.host or harm.concerns(one.host))
    ]
    return _LAST_SECOND + _RATE * max(0.0, one.last - min(since)) if since else 0.0


def most_behind(
    name: str, promise: Promise, one: Run, following: Run, harms: Sequence[Harm]
) -> float:
    """Cycles that may be repeated by who follows one that was struck."""
    if following.host == one.host and promise.kept:
        return _LAST_SECOND
    # For a move the standby makes room; where that fails, the copy is what is left.
    asked = any(harm.kind in MOVES and harm.process == name for harm in harms)
    second = asked or _is_struck_twice(promise, one, harms, name)
    if promise.standby and not (second and promise.copied):
        return LAST_CYCLES + _unseen(one, harms, one.host)
    # A young one's copy may be of the one that it followed, as young or on its way then.
    young = _RATE * 2 * _YOUNG if one.last - one.first < _YOUNG else 0.0
    return promise.copied + young + _unseen(one, harms) if promise.copied else 0.0


def _is_struck_twice(promise: Promise, run: Run, harms: Sequence[Harm], name: str = "") -> bool:
    """Whether one blow fell on its host, and another on one where a copy or a standby may be.

    Which host that is nobody here knows: it may be any other one. A busy machine is no blow.

    Args:
        name: of the process, where a blow to itself counts too: its standby has the same name.
    """
    blows = [harm for harm in harms if harm.kind != OVERLOAD and _is_blow(harm, name)]
    here = [one for one in blows if one.process or one.concerns(run.host)]
    there = [one for one in blows if one.process or one.hosts - {run.host}]
    if any(one is not other for one in here for other in there):
        return True
    # What stops at once wherever the master is not heard, its standby included.
    return promise.isolated and any("*" in one.hosts for one in blows)


def _is_blow(harm: Harm, name: str) -> bool:
    """Whether it may take a copy or a standby out of reach."""
    if harm.process:
        return harm.process == name and harm.kind not in MOVES
    silences = (harm.hides or harm.deafens) and _silence([harm], math.inf) >= _FENCED
    return harm.kills or harm.fills or silences


def _unseen(run: Run, harms: Sequence[Harm], host: str = "") -> float:
    """Cycles of a run that nobody could see: one of them was cut off, and it went on.

    Args:
        host: that was cut off; "": any, for the copies lie on any.
    """
    hiding = [harm for harm in harms if harm.hides and (not host or harm.concerns(host))]
    # What was done explains it, or else a busy machine, since the round began.
    hiding = [harm for harm in hiding if harm.kind != OVERLOAD] or hiding
    since = min((harm.begun for harm in hiding), default=run.last)
    return _RATE * max(0.0, run.last - since)


def may_be_lost(promise: Promise, one: Run, following: Run, harms: Sequence[Harm]) -> bool:
    """Whether there may be nothing to go on from: no copy, none yet, or none within reach."""
    if following.host == one.host:
        return not promise.kept
    if _is_struck_twice(promise, one, harms) or one.last - one.first < _YOUNG:
        return True
    return not (promise.standby or promise.copied)
