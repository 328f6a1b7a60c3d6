"""Record of a demo: samples of the hosts, the master's events, and their summary."""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any, Final

from rosrm import EventRow, Listing, ProcessRow

SAMPLES_FILE: Final = "samples.json"
EVENTS_FILE: Final = "events.jsonl"
#: Kinds of events on failed migrations and versions.
_PROBLEMS: Final = ("stayed", "migration_stuck", "application_failed")

#: States in which a process has ended.
ENDED: Final = ("finished", "failed", "cancelled")
RUNNING: Final = ("starting", "running", "migrating", "stopping")


@dataclass(frozen=True)
class Sample:
    """One look at the cluster.

    Attributes:
        elapsed: seconds by the master's clock.
        usage: fraction by resource and host; None: not known.
        running: processes that run.
        waiting: processes in the queue.
    """

    elapsed: float
    usage: Mapping[str, Mapping[str, float | None]]
    running: int
    waiting: int


@dataclass(frozen=True)
class Move:
    """A migration that came to its end."""

    elapsed: float
    process: str
    source: str
    destination: str


@dataclass
class Record:
    """All observations of a demo.

    Attributes:
        hosts: their names, in order.
        limits: fraction by resource, the same on every host.
        budget: bytes of memory of each host.
        samples: in order of time.
        events: in order of their sequence.
    """

    hosts: tuple[str, ...]
    limits: Mapping[str, float]
    budget: int
    samples: list[Sample] = field(default_factory=list)
    events: list[EventRow] = field(default_factory=list)

    def add(self, view: Listing) -> None:
        """Add a view with hosts, processes and the events since the last one."""
        self.samples.append(sample_of(view))
        self.events.extend(view.events)

    @property
    def last_sequence(self) -> int:
        """Return the sequence number of the newest event; 0: none."""
        return self.events[-1].sequence if self.events else 0

    @property
    def start(self) -> float:
        """Return the time of the first submission, by the master's clock; 0: none."""
        return next((e.elapsed for e in self.events if e.kind == "submitted"), 0.0)

    def of_kind(self, *kinds: str) -> Iterator[EventRow]:
        """Return the events of some kinds."""
        return (event for event in self.events if event.kind in kinds)

    def last_problem(self) -> str:
        """Return why a migration or version failed last, as a clause to append; "" for none."""
        found = [event.message for event in self.of_kind(*_PROBLEMS)]
        return f"; the last problem: {found[-1]}" if found else ""

    def moves(self) -> list[Move]:
        """Return every migration that reached its destination."""
        return [
            Move(event.elapsed, event.process, event.facts["from"], event.facts["to"])
            for event in self.of_kind("migrated")
        ]

    def last_instance(self, process: str) -> tuple[str, int] | None:
        """Return host and number of the last owner of a process."""
        owner: tuple[str, int] | None = None
        moving = owner
        for event in self.events:
            if event.process != process:
                continue
            if event.kind == "assigned":
                owner = event.host, int(event.facts["number"])
            elif event.kind == "migration_begun":
                moving = event.host, int(event.facts["destination"])
            elif event.kind == "migrated":
                owner = moving
        return owner

    # --- files ---------------------------------------------------------------------------

    def write(self, folder: Path) -> None:
        """Write samples and events, each event on a line of its own."""
        plain = {
            "hosts": list(self.hosts),
            "limits": dict(self.limits),
            "budget_bytes": self.budget,
            "start": self.start,
            "samples": [asdict(sample) for sample in self.samples],
        }
        (folder / SAMPLES_FILE).write_text(json.dumps(plain) + "\n")
        lines = (json.dumps(_plain_event(event)) for event in self.events)
        (folder / EVENTS_FILE).write_text("".join(f"{line}\n" for line in lines))

    @classmethod
    def read(cls, folder: Path) -> Record:
        """Read a record from the files of `write`."""
        plain = json.loads((folder / SAMPLES_FILE).read_text())
        lines = (folder / EVENTS_FILE).read_text().splitlines()
        return cls(
            hosts=tuple(plain["hosts"]),
            limits=plain["limits"],
            budget=plain["budget_bytes"],
            samples=[Sample(**sample) for sample in plain["samples"]],
            events=[EventRow(**json.loads(line)) for line in lines],
        )


def sample_of(view: Listing) -> Sample:
    """Return the usages and the counts of a view."""
    usage: dict[str, dict[str, float | None]] = {}
    for host in view.hosts:
        for resource in host.resources:
            known = not resource.stale and math.isfinite(resource.usage)
            value = round(resource.usage, 4) if known else None
            usage.setdefault(resource.name, {})[host.description.name] = value
    states = Counter(row.state for row in view.processes)
    running = sum(states[state] for state in RUNNING)
    return Sample(round(view.uptime, 3), usage, running, states["queued"])


def summarise(
    record: Record, processes: Sequence[ProcessRow], figures: Mapping[str, Any]
) -> dict[str, Any]:
    """Return the figures of `summary.json`.

    Args:
        processes: all, with their states at the end.
        figures: of the map.
    """
    states = Counter(row.state for row in processes)
    assigned = Counter(event.host for event in record.of_kind("assigned"))
    moves = record.moves()
    return {
        "processes": {
            "submitted": len(processes),
            "finished": states["finished"],
            "failed": states["failed"],
            "cancelled": states["cancelled"],
        },
        "hosts": len(record.hosts),
        "assignments": assigned.total(),
        "migrations": len(moves),
        "makespan_s": round(_last_end(record) - record.start, 2),
        "map_makespan_s": round(_last_end(record, "piece_") - record.start, 2),
        **figures,
        "memory_limit_percent": round(100 * record.limits["memory"], 1),
        "memory_budget_bytes": record.budget,
        "per_host": {
            host: {
                "assignments": assigned[host],
                "migrations_from": sum(move.source == host for move in moves),
                "migrations_to": sum(move.destination == host for move in moves),
                "peak_memory_percent": _peak_percent(record, host),
            }
            for host in record.hosts
        },
    }


def _last_end(record: Record, prefix: str = "") -> float:
    ends = (e.elapsed for e in record.of_kind(*ENDED) if e.process.startswith(prefix))
    return max(ends, default=record.start)


def _peak_percent(record: Record, host: str) -> float:
    seen = (sample.usage.get("memory", {}).get(host) for sample in record.samples)
    return round(100 * max((value for value in seen if value is not None), default=0.0), 1)


def _plain_event(event: EventRow) -> dict[str, Any]:
    plain = {one.name: getattr(event, one.name) for one in fields(event)}
    return {**plain, "facts": dict(event.facts)}
