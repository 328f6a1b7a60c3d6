"""Rows of listings, and parts of logs, as plain values."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final, Literal

from rosrm.model.applications import ApplicationRow
from rosrm.model.devices import Device
from rosrm.model.modes import ModeRow
from rosrm.model.values import EMPTY, HostDescription

#: Kinds of offers; "plugin": a plugin that failed before its offers were known.
PluginKind = Literal[
    "probe", "scoring", "filter", "migration", "checkpoint", "launcher", "sink", "plugin"
]
PluginState = Literal["selected", "available", "absent", "broken", "failing"]

#: States of a `HostRow` and of a `ProcessRow`.
HOST_STATES: Final = ("up", "suspect", "expected", "lost", "left", "detached")
PROCESS_STATES: Final = (
    "queued", "set_aside", "scheduled", "assigned", "starting", "running", "backoff", "stopping",
    "migrating", "checkpointed", "finished", "failed", "cancelled", "unreachable", "stuck",
    "unknown",
)  # fmt: skip

#: Beginning of a name in a request for an explanation: a host of this name, not a process.
HOST_MARK: Final = "host:"


@dataclass(frozen=True, slots=True)
class ResourceRow:
    """One resource of a host: fractions 0..1 of its capacity.

    Attributes:
        stale: the reading is old, because its probe is late or failed, or the host is not up.
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
class DeviceRow(Device):
    """One device of a host.

    Attributes:
        free: share of the unit that no instance holds, 0..1; 0 while it is missing.
        holders: instances that hold the unit, "slam#12".
    """

    free: float = 0.0
    holders: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class HostRow:
    """One host.

    Attributes:
        state: "up", "suspect", "expected" (it has not reported since the master started), "lost",
            "left" or "detached" (its slave was stopped and left processes running).
        accepting: the slave is under all its limits and has requested work.
        reading_age: seconds since the newest `resource_info`.
        drained: the host is draining, and no process that can leave is left on it.
        devices: devices of the host, and who holds them.
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
    devices: tuple[DeviceRow, ...] = ()

    @property
    def must_be_left(self) -> bool:
        """Return True if processes have to leave the host: it is over a limit, or is drained."""
        over = any(one.usage >= one.limit and not one.stale for one in self.resources)
        return (self.state == "up" and over) or (self.draining and self.processes > 0)


@dataclass(frozen=True, slots=True)
class ProcessRow:
    """One process.

    Attributes:
        state: "queued", "set_aside", "scheduled", "assigned", "starting", "running", "backoff",
            "stopping", "migrating", "checkpointed", "finished", "failed", "cancelled",
            "unreachable", "stuck" or "unknown" (its host is silent and not lost yet).
        host: host of the owning instance, of the image, or of the last run; "" for none.
        number: number of the owning instance; 0: none.
        migrations: number of its moves; a replacement by a new version of the program is none.
        exit_code: exit code of the last run, a signal as a negative number; None: unknown, or the
            process runs.
        queue_position: 1: head; 0: not in the queue.
        since: seconds in this state.
        cpu: CPU usage in cores.
        memory: memory usage in bytes.
        reason: why it waits, failed, ...
        stale: `cpu` and `memory` are old, because its host is silent or lost.
        owner: principal that submitted it, "user:ada"; "": unknown.
        application: application of which it is a part; "": it is a single process.
        cpu_limit: cores that its host enforces; 0: no limit holds.
        memory_limit: bytes that its host enforces; 0: no limit holds.
        array: name of its array; "": none.
        next_run: unix time of the next run of its schedule; 0: none.
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
    owner: str = ""
    cpu_limit: float = 0.0
    memory_limit: int = 0
    array: str = ""
    next_run: float = 0.0
    application: str = ""


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
        distribution: name and version of the Python distribution.
        host: name of the host; "" for the master.
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
        uptime: seconds since the start of the master.
        last_sequence: sequence of the newest event.
        trouble: why the master accepts no new work now; "": it accepts work.
        security: "keys", or "none": messages need no key.
        strangers: messages without a valid key, as a sentence; "": none in the last hour.
    """

    master: str
    uptime: float
    last_sequence: int
    hosts: Sequence[HostRow] = ()
    processes: Sequence[ProcessRow] = ()
    plugins: Sequence[PluginRow] = ()
    events: Sequence[EventRow] = ()
    applications: Sequence[ApplicationRow] = ()
    modes: Sequence[ModeRow] = ()
    trouble: str = ""
    security: str = "keys"
    strangers: str = ""


#: Most bytes of the content of a `LogPart`; an archive appends one at a time.
LARGEST_LOG_PART: Final = 1 << 20


@dataclass(frozen=True, slots=True)
class LogPart:
    """A part of an instance's log.

    Attributes:
        number: number of the instance.
        numbers: numbers of all instances of the process with a log on the host, ascending.
        content: bytes of the log.
        offset: offset of the content from the first byte that the instance wrote. Bytes between the
            requested offset and this one were dropped.
        next_offset: offset of the next part.
        ended: the instance has ended, and the log is complete.
        marks: time marks of the log: (unix time, offset, pid). All bytes before the offset were
            written by that time. At a pid other than 0, the output of that process begins.
    """

    number: int
    numbers: Sequence[int]
    content: bytes
    offset: int
    next_offset: int
    ended: bool
    marks: Sequence[tuple[float, int, int]]
