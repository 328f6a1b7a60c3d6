"""Rows of listings, and parts of logs: plain values for clients, tables and tests."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

from rosrm.model.values import EMPTY, HostDescription

#: Kinds of offers; "plugin": a fault of a plugin before its offers are known.
PluginKind = Literal["probe", "scoring", "migration", "checkpoint", "launcher", "plugin"]
PluginState = Literal["selected", "available", "absent", "broken", "failing"]


@dataclass(frozen=True, slots=True)
class ResourceRow:
    """One resource of a host: fractions 0..1 of its capacity.

    Attributes:
        stale: the reading is old: its probe is late or failed, or the host is not up.
    """

    name: str
    unit: str
    capacity: float
    scope: str
    usage: float
    in_flight: float
    limit: float
    stale: bool


@dataclass(frozen=True, slots=True)
class HostRow:
    """One host.

    Attributes:
        state: "up", "suspect", "lost", "left" or "detached" (its slave was stopped and left
            processes running).
        accepting: the slave is under all its limits and has asked for work.
        reading_age: seconds since the newest `resource_info`.
        drained: it is draining, and no process is left on it that can leave.
    """

    description: HostDescription
    host_id: int
    state: str
    cordoned: bool
    draining: bool
    accepting: bool
    reading_age: float
    resources: tuple[ResourceRow, ...]
    processes: int
    drained: bool = False


@dataclass(frozen=True, slots=True)
class ProcessRow:
    """One process.

    Attributes:
        state: "queued", "set_aside", "assigned", "starting", "running", "backoff", "stopping",
            "migrating", "checkpointed", "finished", "failed", "cancelled", "unreachable", "stuck"
            or "unknown" (its host is silent, and not lost yet).
        host: of the owning instance, or of the image, or of its end; "" for none.
        number: of the owning instance; 0: none.
        exit_code: of the last run, a signal as a negative number; None: unknown, or it runs.
        queue_position: 1 is the head; 0: not in the queue.
        since: seconds in this state.
        cpu: cores.
        memory: bytes.
        reason: why it waits, failed, ...
        stale: `cpu` and `memory` are old, as its host is silent or lost.
    """

    name: str
    kind: str
    state: str
    host: str
    number: int
    pid: int
    restarts: int
    migrations: int
    exit_code: int | None
    priority: int
    queue_position: int
    since: float
    cpu: float
    memory: int
    reason: str
    stale: bool = False


@dataclass(frozen=True, slots=True)
class EventRow:
    """One line of the event record.

    Attributes:
        wall_time: unix time by the master's clock, seconds.
        elapsed: seconds since the master's start, by its monotonic clock.
    """

    sequence: int
    wall_time: float
    elapsed: float
    kind: str
    process: str
    host: str
    message: str
    facts: Mapping[str, Any] = field(default_factory=lambda: EMPTY)


@dataclass(frozen=True, slots=True)
class PluginRow:
    """One offer of a plugin, or a fault.

    Attributes:
        distribution: name and version of the package that brings it.
        host: "" for the master.
    """

    kind: PluginKind
    name: str
    distribution: str
    state: PluginState
    reason: str
    host: str = ""


@dataclass(frozen=True, slots=True)
class Listing:
    """An answer to a listing; parts that the client did not request are empty.

    Attributes:
        master: name of the master.
        uptime: of the master, seconds.
        last_sequence: of the event record.
        trouble: why the master accepts no new work now; "": it does.
    """

    master: str
    uptime: float
    last_sequence: int
    hosts: Sequence[HostRow] = ()
    processes: Sequence[ProcessRow] = ()
    plugins: Sequence[PluginRow] = ()
    events: Sequence[EventRow] = ()
    trouble: str = ""


@dataclass(frozen=True, slots=True)
class LogPart:
    """A part of an instance's log.

    Attributes:
        number: of the instance.
        numbers: of all instances of the process whose logs the host holds, ascending.
        content: the bytes.
        offset: of the content, from the first byte that the instance wrote. Bytes between the
            requested offset and this one were dropped.
        next_offset: offset of the next part.
        ended: the instance has ended, and the log is complete.
        marks: checks of the log: (unix time, offset, pid). Everything before the offset had been
            written by that time; a pid not 0 is that of a process whose output begins there.
    """

    number: int
    numbers: Sequence[int]
    content: bytes
    offset: int
    next_offset: int
    ended: bool
    marks: Sequence[tuple[float, int, int]]
