"""Observations of a run: usage of each host, and events of the master."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any


@dataclass(frozen=True)
class HostLook:
    """A host at one look.

    Attributes:
        usage: of its memory, fraction; None: not known.
        in_flight: reservations: fraction that was assigned and is not in the reading yet.
        capacity: bytes.
        accepting: it is under its limits and has requested work.
    """

    usage: float | None
    in_flight: float
    capacity: float
    accepting: bool

    @property
    def load(self) -> float:
        """Return the usage with reservations, fraction; infinite where it is not known."""
        return float("inf") if self.usage is None else self.usage + self.in_flight


@dataclass(frozen=True)
class Look:
    """The cluster at one moment.

    Attributes:
        elapsed: seconds since the master's start.
        hosts: by name.
        states: of the processes, by name.
        memory: bytes of the processes, by name.
    """

    elapsed: float
    hosts: Mapping[str, HostLook]
    states: Mapping[str, str]
    memory: Mapping[str, float] = field(default_factory=dict)

    def count(self, state: str) -> int:
        """Return the number of processes in a state."""
        return sum(one == state for one in self.states.values())

    @classmethod
    def of(cls, plain: Mapping[str, Any]) -> Look:
        """Build a look from an answer of the desk."""
        hosts = {name: HostLook(**host) for name, host in plain["hosts"].items()}
        return cls(plain["elapsed"], hosts, plain["states"], plain["memory"])


@dataclass(frozen=True)
class Happening:
    """A line of the master's event record; the fields are those of `EventRow`."""

    sequence: int
    elapsed: float
    wall_time: float
    kind: str
    process: str
    host: str
    message: str = ""
    facts: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Move:
    """A migration that reached its destination.

    Attributes:
        begun, ended: seconds since the master's start.
        size: bytes that the process used when it began.
    """

    process: str
    source: str
    destination: str
    begun: float
    ended: float
    size: float


@dataclass
class Trace:
    """All observations of a run.

    Attributes:
        start: seconds of the master's clock at which the run's own time is 0.
        looks: in order of time.
        events: in order of their sequence.
    """

    start: float = 0.0
    looks: list[Look] = field(default_factory=list)
    events: list[Happening] = field(default_factory=list)

    def add(self, plain: Mapping[str, Any]) -> Look:
        """Add an answer of the desk."""
        look = Look.of(plain)
        self.looks.append(look)
        self.events += [Happening(**event) for event in plain["events"]]
        return look

    @property
    def last_sequence(self) -> int:
        """Return the sequence number of the newest event; 0: none."""
        return self.events[-1].sequence if self.events else 0

    @property
    def hosts(self) -> list[str]:
        """Return the names of all hosts ever seen, in natural order (host2 before host10)."""
        names = {name for look in self.looks for name in look.hosts}
        return sorted(names, key=lambda name: (len(name), name))

    def of_kind(self, *kinds: str) -> Iterator[Happening]:
        """Return the events of some kinds."""
        return (event for event in self.events if event.kind in kinds)

    def placed(self) -> list[Happening]:
        """Return the last assignment of each process: one that no slave took is repeated."""
        return list({event.process: event for event in self.of_kind("assigned")}.values())

    def before(self, elapsed: float) -> Look | None:
        """Return the last look before a moment of the master's clock."""
        found = None
        for look in self.looks:
            if look.elapsed >= elapsed:
                break
            found = look
        return found

    def moves(self) -> list[Move]:
        """Return every migration that reached its destination, in order."""
        begun: dict[str, Happening] = {}
        moves = []
        for event in self.of_kind("migration_begun", "migrated"):
            if event.kind == "migration_begun":
                begun[event.process] = event
                continue
            first = begun.pop(event.process, event)
            look = self.before(first.elapsed)
            size = look.memory.get(event.process, 0.0) if look else 0.0
            moves.append(
                Move(event.process, event.facts["from"], event.facts["to"], first.elapsed,
                     event.elapsed, size)
            )  # fmt: skip
        return moves

    # --- for files and pictures -----------------------------------------------------------

    def times(self) -> list[float]:
        """Return the seconds of the run at each look."""
        return [round(look.elapsed - self.start, 2) for look in self.looks]

    def percent(self, host: str) -> list[float | None]:
        """Return a host's memory utilisation at each look, percent; None: not known, or absent."""
        seen = [look.hosts.get(host) for look in self.looks]
        return [
            None if one is None or one.usage is None else round(100 * one.usage, 2) for one in seen
        ]

    def curves(self) -> dict[str, Any]:
        """Return times, utilisations and assignments, plain."""
        return {
            "elapsed_s": self.times(),
            "memory_percent": {host: self.percent(host) for host in self.hosts},
            "assignments": self.assignments(),
            "given_again": sum(1 for _ in self.of_kind("assigned")) - len(self.placed()),
        }

    def assignments(self) -> list[dict[str, Any]]:
        """Return time, process and host of each assignment, plain."""
        return [
            {"s": round(event.elapsed - self.start, 2), "process": event.process,
             "host": event.host}
            for event in self.of_kind("assigned")
        ]  # fmt: skip


def per_host(assignments: Sequence[Happening]) -> dict[str, int]:
    """Return the number of processes of each host."""
    counts: dict[str, int] = {}
    for event in assignments:
        counts[event.host] = counts.get(event.host, 0) + 1
    return dict(sorted(counts.items(), key=lambda one: (len(one[0]), one[0])))
