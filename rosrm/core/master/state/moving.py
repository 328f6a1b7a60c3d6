"""State of preemption and rebalancing; nothing of it is journaled."""

from __future__ import annotations

from dataclasses import dataclass, field
from math import inf

from rosrm.core.master.state.backoff import Retries
from rosrm.core.master.state.hosts import Host


@dataclass(frozen=True, slots=True)
class RoomMade:
    """Room that processes of lower priorities make for a queued process.

    Attributes:
        host: where they leave; None: no set of them can make room.
        reason: a sentence for `explain`; "": not known now.
        until: time until which the host is reserved, although nothing leaves it any more; without a
            host, time before which the master does not look for a set again.
        partial: True: more processes must leave, whose moves had to wait for others.
        tried: hosts where room was made, but which a policy or a reading excludes for another
            reason, or that was not made in time.
        deadline: time at which the host is given up, whatever still leaves it.
    """

    host: Host | None
    reason: str
    until: float
    partial: bool = False
    tried: Retries = field(default_factory=Retries)
    deadline: float = inf


@dataclass(slots=True)
class Preemption:
    """State of the preemption.

    Attributes:
        room_made: name of a queued process to the room that others make for it.
        reviewed: time of the last review.
    """

    room_made: dict[str, RoomMade] = field(default_factory=dict)
    reviewed: float = -inf

    def forget(self, host: str) -> None:
        """Forget where room was made without success, because the host has changed."""
        for room in self.room_made.values():
            room.tried.forget(host)


@dataclass(slots=True)
class Rebalancing:
    """State of the rebalancing.

    Attributes:
        pending: (process, destination) of the moves of a round that have not begun.
        uneven_since: time since when the spread exceeds the threshold; inf: it does not.
        joined_at: time at which the newest host registered; -inf: none did.
        due: time before which no round begins automatically.
    """

    pending: list[tuple[str, str]] = field(default_factory=list)
    uneven_since: float = inf
    joined_at: float = -inf
    due: float = -inf
