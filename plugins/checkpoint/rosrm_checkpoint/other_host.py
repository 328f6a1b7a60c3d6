"""`other-host`: a copy of the newest state on so many other hosts, the same ones for long."""

from __future__ import annotations

import zlib
from dataclasses import dataclass

from rosrm import (
    CheckpointChoice,
    CheckpointView,
    Fraction,
    MemoryView,
    PositiveCount,
    PositiveSeconds,
)


@dataclass(frozen=True)
class OtherHostOptions:
    """What can be set.

    Attributes:
        every: seconds between two transfers to a host, at least.
        copies: hosts that keep a state, beside the process's own.
        apart_by: label in which they are to differ from it, as far as such hosts are up; "": none.
        away: part of its time that a process may be away for checkpoints of its memory, at most.
    """

    every: PositiveSeconds = 1.0
    copies: PositiveCount = 1
    apart_by: str = ""
    away: Fraction = 0.05

    def __post_init__(self) -> None:
        """Refuse a part that leaves no time for one."""
        if not 0.0 < self.away <= 1.0:
            raise ValueError(f"away is {self.away:g}; allowed: more than 0, at most 1")


class OtherHost:
    """Keeps to the hosts that have a state already, so that it seldom travels to a new one.

    Those with the newest go first: a good copy is never left for one of a former instance.
    Which ones those are is settled by a digest of the names: different processes go to different
    hosts, and nothing that changes with time decides.
    """

    def __init__(self, options: OtherHostOptions) -> None:
        self._options = options

    def choose(self, process: CheckpointView) -> CheckpointChoice | None:
        """The hosts that keep it."""
        others = sorted(name for name in process.hosts if name != process.host)
        others.sort(key=lambda name: self._rank(name, process))
        return CheckpointChoice(tuple(others[: self._options.copies]), self._options.every)

    def pace(self, process: MemoryView) -> float:
        """As the process asks, but no faster than it can be borne."""
        return max(process.asked, process.pause / self._options.away)

    def _rank(self, name: str, process: CheckpointView) -> tuple[bool, int, int]:
        """Lower goes first."""
        near, kept_on = self._is_near(name, process), process.kept_on
        place = kept_on.index(name) if name in kept_on else len(kept_on)
        return near, place, zlib.crc32(f"{process.spec.name}\n{name}".encode())

    def _is_near(self, name: str, process: CheckpointView) -> bool:
        """Whether it may be lost together with the process's own host."""
        label = self._options.apart_by
        if not label:
            return False
        own = process.hosts.get(process.host, {}).get(label)
        return process.hosts[name].get(label) == own
