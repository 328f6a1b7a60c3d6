"""Guarantees for a process, and allowances: disturbances that explain a deviation from them.

Pure; imports nothing from rosrm.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Final

from benchmarks.chaos.outputs import Run

#: Seconds for the parts to discover each other by DDS once no fault prevents it.
MEETING: Final = 3.0
#: The same where a part was restarted: it has to come up before.
STARTING: Final = 8.0
#: Cycles that the successor of a killed process may repeat: the last one, and one before.
LAST_CYCLES: Final = 2
#: The same where the machine is busy: a snapshot is at most a second old, ten cycles.
_LAST_SECOND: Final = 12
#: Seconds of silence after which a host that is cut off may have stopped isolated processes:
#: 1.425 s by its fence (lease 3 s, suspect 1 s), less a beat (0.2 s) before and one after, and less
#: the same once more because a busy machine processes messages late.
FENCED: Final = 0.8
#: Seconds of silence after which a host may be lost: the lease, less a second for the next contact.
_LOST: Final = 2.0
#: Seconds from the last "active" of a process that is being ended until it has ended.
_ENDING: Final = 0.5
#: Seconds after which a snapshot has reached another host.
_YOUNG: Final = 6.0
#: Kinds that the benchmark requests, and that end or silence no process by force.
MOVES: Final = ("move", "overlap")
#: Kind of the disturbance by other programs on the machine.
OVERLOAD: Final = "overload"
#: Seconds before an overload is measured at its slave in which a process may have stalled already.
_STALLING: Final = 1.0
#: Cycles a second.
_RATE: Final = 10.0


@dataclass(frozen=True)
class Guarantees:
    """The guarantees for a service.

    Attributes:
        members: processes of one instance.
        stateful: its count continues across instances.
        standby: it has a second instance, silent.
        elsewhere: it is restarted on another host when its own is lost.
        isolated: its host stops it when it is cut off.
        kept: its own host has its snapshot on disk.
        copied: cycles by which a replica on another host may be behind; 0: there is none.
    """

    members: int = 1
    stateful: bool = False
    standby: bool = False
    elsewhere: bool = False
    isolated: bool = False
    kept: bool = False
    copied: int = 0


@dataclass(frozen=True)
class Disturbance:
    """A fault, a request or an overload in the lab, and the deviations that it may explain.

    Attributes:
        kind: of the fault; or "move", "overlap" (a migration during which both may be active).
        hosts: that were concerned; "*": all of them.
        process: that was struck or moved; "": no single one.
        instance: that a fence ended: only its end is explained; "": no single one.
        begun, ended: monotonic time.
        kills: the processes on the hosts end.
        hides: the hosts and the master have no contact.
        restarts: a part had to be restarted.
        forgets: the end of a job there in this time may be unknown.
        fills: the full disk there took no more snapshots.
        deafens: fences there had no proof that the slave works, or that the master reaches it.
    """

    kind: str
    begun: float
    ended: float
    hosts: frozenset[str] = frozenset()
    process: str = ""
    instance: str = ""
    kills: bool = False
    hides: bool = False
    restarts: bool = False
    forgets: bool = False
    fills: bool = False
    deafens: bool = False

    def concerns(self, host: str) -> bool:
        """Return True if a host was concerned."""
        return host in self.hosts or "*" in self.hosts


def may_end(
    name: str, guarantees: Guarantees, run: Run, disturbances: Sequence[Disturbance]
) -> bool:
    """Return True if a fault or a request explains the end of a run of a process."""
    return any(
        disturbance.process == name or (disturbance.kills and disturbance.concerns(run.host))
        for disturbance in disturbances
    ) or _is_parted(guarantees, run, disturbances)


def _is_parted(guarantees: Guarantees, run: Run, disturbances: Sequence[Disturbance]) -> bool:
    """Return True if the silence was long enough for its host or the master to end it."""
    if not (guarantees.elsewhere or guarantees.isolated):
        return False
    here = [disturbance for disturbance in disturbances if disturbance.concerns(run.host)]
    # A process stalls with its slave: its last "active" is older than its end.
    stalled = [
        disturbance.ended
        for disturbance in here
        if disturbance.kind == OVERLOAD and disturbance.begun <= run.last + _STALLING
    ]
    until = max([run.last + _ENDING, *stalled])
    hidden = _silence([disturbance for disturbance in here if disturbance.hides], until)
    deaf = _silence([disturbance for disturbance in here if disturbance.deafens], until)
    # In a cut, a host stops a process that is not isolated only if it cannot reach its slave.
    return deaf >= FENCED or hidden >= (FENCED if guarantees.isolated else _LOST)


def _silence(disturbances: Iterable[Disturbance], until: float) -> float:
    """Return the seconds until a moment that at least one of them covered; gaps do not count.

    A restarted part is silent until it is up.
    """
    silent, covered = 0.0, 0.0
    for disturbance in sorted(disturbances, key=lambda one: one.begun):
        begun = max(disturbance.begun, covered)
        ended = min(disturbance.ended + (STARTING if disturbance.restarts else 0.0), until)
        silent += max(0.0, ended - begun)
        covered = max(covered, ended)
    return silent


def is_struck(
    name: str, guarantees: Guarantees, run: Run, disturbances: Sequence[Disturbance]
) -> bool:
    """Return True if a run ended by force, and not by a migration."""
    return any(
        (disturbance.process == name and disturbance.kind not in MOVES)
        or (disturbance.kills and disturbance.concerns(run.host))
        for disturbance in disturbances
    ) or _is_parted(guarantees, run, disturbances)


def unkept(one: Run, following: Run, disturbances: Sequence[Disturbance]) -> float:
    """Return the cycles that a successor may repeat because a disk was full; 0: no disk was.

    A successor on the same host restores the snapshot there, one on another host any replica.
    """
    since = [
        disturbance.begun
        for disturbance in disturbances
        if disturbance.fills and (following.host != one.host or disturbance.concerns(one.host))
    ]
    return _LAST_SECOND + _RATE * max(0.0, one.last - min(since)) if since else 0.0


def most_behind(
    name: str, guarantees: Guarantees, one: Run, following: Run, disturbances: Sequence[Disturbance]
) -> float:
    """Return the cycles that the successor of a struck instance may repeat."""
    if following.host == one.host and guarantees.kept:
        return _LAST_SECOND
    # For a migration the standby makes room. Where the migration fails, the replica is left.
    requested = any(
        disturbance.kind in MOVES and disturbance.process == name for disturbance in disturbances
    )
    second = requested or _is_struck_twice(guarantees, one, disturbances, name)
    if guarantees.standby and not (second and guarantees.copied):
        return LAST_CYCLES + _unseen(one, disturbances, one.host)
    # The replica of a young instance may be its predecessor's, as young or in transit then.
    young = _RATE * 2 * _YOUNG if one.last - one.first < _YOUNG else 0.0
    return guarantees.copied + young + _unseen(one, disturbances) if guarantees.copied else 0.0


def _is_struck_twice(
    guarantees: Guarantees, run: Run, disturbances: Sequence[Disturbance], name: str = ""
) -> bool:
    """Return True if one fault hit its host, and another one the host of a replica or a standby.

    The host of the replica or standby is not known here, so any other one counts. An overload does
    not count.

    Args:
        name: of the process, where a fault to itself counts too: its standby has the same name.
    """
    blows = [
        disturbance
        for disturbance in disturbances
        if disturbance.kind != OVERLOAD and _is_blow(disturbance, name)
    ]
    here = [one for one in blows if one.process or one.concerns(run.host)]
    there = [one for one in blows if one.process or one.hosts - {run.host}]
    if any(one is not other for one in here for other in there):
        return True
    # Isolated processes, the standby included, stop at once wherever the master is not reachable.
    return guarantees.isolated and any("*" in one.hosts for one in blows)


def _is_blow(disturbance: Disturbance, name: str) -> bool:
    """Return True if it may take a replica or a standby out of reach."""
    if disturbance.process:
        return disturbance.process == name and disturbance.kind not in MOVES
    silences = (disturbance.hides or disturbance.deafens) and _silence(
        [disturbance], math.inf
    ) >= FENCED
    return disturbance.kills or disturbance.fills or silences


def _unseen(run: Run, disturbances: Sequence[Disturbance], host: str = "") -> float:
    """Return the cycles of a run that went unseen: a host was cut off, and the run continued.

    Args:
        host: that was cut off; "": any, because replicas may be on any.
    """
    hiding = [
        disturbance
        for disturbance in disturbances
        if disturbance.hides and (not host or disturbance.concerns(host))
    ]
    # A fault explains it, or else an overload, since the round began.
    hiding = [disturbance for disturbance in hiding if disturbance.kind != OVERLOAD] or hiding
    since = min((disturbance.begun for disturbance in hiding), default=run.last)
    return _RATE * max(0.0, run.last - since)


def may_be_lost(
    guarantees: Guarantees, one: Run, following: Run, disturbances: Sequence[Disturbance]
) -> bool:
    """Return True if the successor may lack a snapshot: no replica, none yet, or out of reach."""
    if following.host == one.host:
        return not guarantees.kept
    if _is_struck_twice(guarantees, one, disturbances) or one.last - one.first < _YOUNG:
        return True
    return not (guarantees.standby or guarantees.copied)
