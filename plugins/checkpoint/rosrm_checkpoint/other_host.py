"""Checkpoint policy `other-host`: replicas of the newest snapshot on a stable set of hosts."""

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
    """Options of the policy `other-host`.

    Attributes:
        every: seconds between two transfers to a host, at least.
        copies: number of hosts that keep a replica, beside the process's own host.
        apart_by: label in which these hosts differ from the process's host, as far as such hosts
            are up; "": no label.
        away: largest fraction of its time that a process may be stopped for checkpoint images;
            above 0, at most 1.
    """

    every: PositiveSeconds = 1.0
    copies: PositiveCount = 1
    apart_by: str = ""
    away: Fraction = 0.05

    def __post_init__(self) -> None:
        """Raise `ValueError` if `away` is not above 0 and at most 1."""
        if not 0.0 < self.away <= 1.0:
            raise ValueError(f"away is {self.away:g}; allowed: more than 0, at most 1")


class OtherHost:
    """Policy that prefers the hosts that hold a replica already, so that transfers stay rare.

    Hosts with the newest replicas come first: a good replica is never given up for one of a former
    instance. A digest of the names of process and host orders all other hosts. So different
    processes use different hosts, and the order does not change with time.
    """

    def __init__(self, options: OtherHostOptions) -> None:
        self._options = options

    def choose(self, process: CheckpointView) -> CheckpointChoice | None:
        """Return the hosts that keep replicas of the process's snapshot."""
        others = sorted(name for name in process.hosts if name != process.host)
        others.sort(key=lambda name: self._rank(name, process))
        return CheckpointChoice(tuple(others[: self._options.copies]), self._options.every)

    def pace(self, process: MemoryView) -> float:
        """Return the checkpoint period (s): as the process asks, but long enough for `away`."""
        return max(process.asked, process.pause / self._options.away)

    def _rank(self, name: str, process: CheckpointView) -> tuple[bool, int, int]:
        """Return the sort key of a host; the lowest key is chosen first."""
        near, replica_hosts = self._is_near(name, process), process.replica_hosts
        place = replica_hosts.index(name) if name in replica_hosts else len(replica_hosts)
        return near, place, zlib.crc32(f"{process.spec.name}\n{name}".encode())

    def _is_near(self, name: str, process: CheckpointView) -> bool:
        """Return True if a host may be lost together with the process's own host.

        A host without the label may be anywhere.
        """
        label = self._options.apart_by
        if not label:
            return False
        own = process.hosts.get(process.host, {}).get(label)
        there = process.hosts[name].get(label)
        return None in (own, there) or there == own
