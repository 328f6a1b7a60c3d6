"""Conversion of the core's events and decisions to the content of frames and back.

Readings and usages are written as arrays, all other events as JSON with the fields of their
dataclass. Numbers keep every bit, because a difference in the last digit could change a decision in
a replay.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, Final, get_args

import numpy as np

from rosrm.core.master import events as happened
from rosrm.core.master.commands import (
    Assign,
    Command,
    PublishStateConfig,
    Redeliver,
    SendOrder,
    Withdraw,
)
from rosrm.model.codec import from_plain, to_plain
from rosrm.model.orders import (
    AmendInstance,
    FenceInstance,
    Order,
    ReportInstances,
    RestartInstance,
    RunExecutor,
    SetLifecycleState,
    StartInstance,
    StopInstance,
)
from rosrm.model.values import RESOURCE_SLOTS
from rosrm.recording.frames import FrameKind

#: Seconds by the master's monotonic clock, and unix time.
_TIMES: Final = struct.Struct("<dd")
#: Number of readings, number of slots in use, usage and limit of all other slots.
_READINGS: Final = struct.Struct("<IIdd")
_USAGES: Final = struct.Struct("<qQI")
_COLUMNS: Final = (
    ("host_id", "<i8"), ("incarnation", "<u8"), ("sequence", "<u8"), ("status_sequence", "<u8"),
    ("accepting", "?"), ("stale", "<u4"),
)  # fmt: skip

#: Orders that are decisions. Orders about replicas are not, because they place no instance.
_ORDERS: Final[Mapping[type[Order], str]] = MappingProxyType(
    {
        StartInstance: "start",
        StopInstance: "stop",
        FenceInstance: "fence",
        RestartInstance: "restart",
        AmendInstance: "set_restart",  # its name in rosrm 0.1.0
        SetLifecycleState: "set_lifecycle",
        RunExecutor: "execute",
        ReportInstances: "report",
    }
)
#: Bits of an order's number to its series, in recordings of rosrm 0.1.0.
_SERIES_OF_0_1_0: Final = MappingProxyType({41: "replication", 42: "capability", 43: "periodic"})
#: Events that recordings of rosrm 0.1.0 name differently: former name of the event to its name, a
#: field, and the former name of that field.
_RENAMED: Final = MappingProxyType(
    {
        "HostRegistered": ("HostRegistered", "snapshots", "kept"),
        "HostLeft": ("HostLeft", "left_running", "kept"),
        "KeptStatesReceived": ("SnapshotsReported", "snapshots", "states"),
    }
)
_KINDS: Final[Mapping[str, type[Any]]] = MappingProxyType(
    {kind.__name__: kind for kind in get_args(happened.Event)}
)


@dataclass(frozen=True, slots=True)
class Happened:
    """One event and the time at which the core handled it.

    Attributes:
        now: seconds by the master's monotonic clock.
        wall: unix time of the core in seconds.
        decided: the core's decisions (`decisions`), one line each; None: not recorded.
    """

    now: float
    wall: float
    event: happened.Event
    decided: tuple[str, ...] | None = None


# --- events -----------------------------------------------------------------------------------


def encode(event: happened.Event, now: float, wall: float) -> tuple[FrameKind, bytes]:
    """Return an event as kind and content of a frame."""
    times = _TIMES.pack(now, wall)
    if isinstance(event, happened.ReadingsReceived):
        return FrameKind.READINGS, times + _encoded_readings(event)
    if isinstance(event, happened.UsagesReceived):
        return FrameKind.USAGES, times + _encoded_usages(event)
    plain = {"kind": type(event).__name__, **to_plain(event)}
    return FrameKind.EVENT, times + json.dumps(plain, separators=(",", ":")).encode()


def decode(kind: FrameKind, content: bytes) -> Happened:
    """Return the event of a frame; raise `ValueError` for invalid content."""
    try:
        now, wall = _TIMES.unpack_from(content)
        rest = content[_TIMES.size :]
        if kind is FrameKind.READINGS:
            return Happened(now, wall, _decoded_readings(rest))
        if kind is FrameKind.USAGES:
            return Happened(now, wall, _decoded_usages(rest))
        plain = json.loads(rest)
        kind_of_event = _KINDS[_rename(plain)]
        if kind_of_event is happened.OrderAnswered:
            plain["order"] = _order_id(plain["order"])
        if isinstance(plain.get("by"), str):  # of rosrm 0.1.0, in which each client was an operator
            plain["by"] = [plain["by"], True]
        event: happened.Event = from_plain(kind_of_event, plain)
    except (struct.error, KeyError, TypeError, AttributeError) as fault:
        raise ValueError(f"{type(fault).__name__}: {fault}") from None
    return Happened(now, wall, event)


def _rename(plain: dict[str, Any]) -> str:
    """Remove and return the name of an event; rename its field if rosrm 0.1.0 wrote it."""
    name: str = plain.pop("kind")
    if name in _RENAMED:
        name, field, former = _RENAMED[name]
        if former in plain:
            plain[field] = plain.pop(former)
    return name


def _order_id(plain: Any) -> Any:
    """Return the id of an order; rosrm 0.1.0 wrote those of a series as one large number."""
    series = _SERIES_OF_0_1_0.get(plain.bit_length()) if isinstance(plain, int) else None
    return plain if series is None else [series, plain - (1 << plain.bit_length() - 1)]


def _encoded_readings(event: happened.ReadingsReceived) -> bytes:
    """Return all columns; of usage and limit only the slots up to the last one in use."""
    count = len(event.host_id)
    spare = (float(event.usage[0, -1]), float(event.limit[0, -1])) if count else (0.0, 0.0)
    used = np.zeros(RESOURCE_SLOTS, np.bool_)
    for values, filler in ((event.usage, spare[0]), (event.limit, spare[1])):
        used |= (values != filler).any(axis=0)
    slots = int(np.flatnonzero(used)[-1]) + 1 if used.any() else 0
    columns = [getattr(event, name).astype(kind).tobytes() for name, kind in _COLUMNS]
    columns += [v[:, :slots].astype("<f8").tobytes() for v in (event.usage, event.limit)]
    return b"".join([_READINGS.pack(count, slots, *spare), *columns])


def _decoded_readings(content: bytes) -> happened.ReadingsReceived:
    count, slots, usage_filler, limit_filler = _READINGS.unpack_from(content)
    at = _READINGS.size
    columns: dict[str, Any] = {}
    for name, kind in _COLUMNS:
        values = np.frombuffer(content, kind, count, at)
        columns[name] = values.astype(values.dtype.newbyteorder("="))
        at += values.nbytes
    for name, filler in (("usage", usage_filler), ("limit", limit_filler)):
        whole = np.full((count, RESOURCE_SLOTS), filler)
        values = np.frombuffer(content, "<f8", count * slots, at)
        whole[:, :slots] = values.reshape(count, slots)
        columns[name] = whole
        at += values.nbytes
    return happened.ReadingsReceived(**columns)


def _encoded_usages(event: happened.UsagesReceived) -> bytes:
    head = _USAGES.pack(event.host_id, event.incarnation, len(event.numbers))
    columns = ((event.numbers, "<u8"), (event.cpu, "<f8"), (event.memory, "<f8"))
    parts = [values.astype(kind).tobytes() for values, kind in columns]
    parts += [
        bytes([slot]) + values.astype("<f8").tobytes() for slot, values in event.others.items()
    ]
    return head + b"".join(parts)


def _decoded_usages(content: bytes) -> happened.UsagesReceived:
    host_id, incarnation, count = _USAGES.unpack_from(content)
    at = _USAGES.size
    columns = []
    for kind in ("<u8", "<f8", "<f8"):
        values = np.frombuffer(content, kind, count, at)
        columns.append(values.astype(values.dtype.newbyteorder("=")))
        at += values.nbytes
    others = {}
    while at < len(content):  # rosrm 0.1.0 wrote cores and bytes alone
        values = np.frombuffer(content, "<f8", count, at + 1)
        others[content[at]] = values.astype(values.dtype.newbyteorder("="))
        at += 1 + values.nbytes
    numbers, cpu, memory = columns
    return happened.UsagesReceived(host_id, incarnation, numbers, cpu, memory, others)


# --- decisions --------------------------------------------------------------------------------


def decisions(commands: Sequence[Command]) -> tuple[str, ...]:
    """Return the commands that start, stop or move instances, one line each, for comparison."""
    return tuple(line for command in commands if (line := _decision(command)))


def _decision(command: Command) -> str:
    if isinstance(command, Assign):
        return f"assign {command.assignment.instance} to host {command.host_id}"
    if isinstance(command, Redeliver):
        return f"assign {command.assignment.instance} to host {command.host_id} again"
    if isinstance(command, Withdraw):
        return f"withdraw {command.instance} from host {command.host_id}"
    if isinstance(command, SendOrder) and type(command.order) in _ORDERS:
        instance = getattr(command.order, "instance", None)
        what = _ORDERS[type(command.order)] + (f" {instance}" if instance else "")
        return f"{what} on host {command.host_id}"
    if isinstance(command, PublishStateConfig):
        way = f"from {command.source} to {command.destination}"
        return f"{command.phase.name} {command.process} {way}"
    return ""


def encode_decisions(decided: Sequence[str]) -> bytes:
    """Return the content of a frame of decisions, which belong to the event before them."""
    return json.dumps(list(decided), separators=(",", ":")).encode()


def decode_decisions(content: bytes) -> tuple[str, ...]:
    """Return the decisions of a frame; raise `ValueError` for invalid content."""
    lines = json.loads(content)
    if not isinstance(lines, list) or not all(isinstance(line, str) for line in lines):
        raise ValueError("a list of decisions is required")
    return tuple(lines)
