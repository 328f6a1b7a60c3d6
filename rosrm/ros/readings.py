"""`resource_info` as bytes: a thousand messages are decoded by one numpy call.

The message has a fixed size, so its CDR form is a C struct behind a header of four bytes; the test
of this module compares every field with rclpy's own serialisation.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np
import numpy.typing as npt

from rosrm.core.events import ReadingsReceived
from rosrm.core.model import RESOURCE_SLOTS
from rosrm.version import PROTOCOL_VERSION

#: Encapsulation: little-endian plain CDR, no options.
_HEADER: Final = b"\x00\x01\x00\x00"

LAYOUT: Final = np.dtype(
    [
        ("header", "S4"),
        ("protocol_version", "<u2"), ("flags", "<u2"), ("host_id", "<u4"),
        ("incarnation", "<u8"), ("sequence", "<u8"), ("beat", "<u8"), ("master_beat", "<u8"),
        ("status_sequence", "<u8"),
        ("processes", "<u4"), ("present", "<u4"), ("stale", "<u4"), ("reserved", "<u4"),
        ("usage", "<f4", (RESOURCE_SLOTS,)), ("limit", "<f4", (RESOURCE_SLOTS,)),
    ]
)  # fmt: skip

ACCEPTING: Final = 1


@dataclass(frozen=True, slots=True)
class Decoded:
    """A batch of messages.

    Attributes:
        readings: the newest of each run of a host; None: there is none.
        beats: (host id, incarnation) to the newest beat of that run of a slave, ns.
        strangers: one line for each kind of message that was refused.
        received: messages of our version.
    """

    readings: ReadingsReceived | None = None
    beats: dict[tuple[int, int], int] = field(default_factory=dict)
    strangers: tuple[str, ...] = ()
    received: int = 0


def encode(row: npt.NDArray[np.void]) -> bytes:
    """The serialised message of one record of `LAYOUT` (shape ())."""
    row["header"] = _HEADER
    raw = bytearray(row.tobytes())
    raw[:4] = _HEADER  # numpy strips trailing zeros of a byte string
    return bytes(raw)


def decode(messages: Sequence[bytes]) -> Decoded:
    """Take in serialised messages, oldest first.

    Messages of another size, byte order or protocol version are refused, never misread.
    """
    fit = [raw for raw in messages if len(raw) == LAYOUT.itemsize and raw[1] == 1]
    strangers = []
    if len(fit) < len(messages):
        strangers.append("a resource_info of another size than ours: another version of rosrm?")
    if not fit:
        return Decoded(strangers=tuple(strangers))
    rows = np.frombuffer(b"".join(fit), LAYOUT)
    ours = rows["protocol_version"] == PROTOCOL_VERSION
    strangers += [
        f"a resource_info of protocol version {version}; this side speaks {PROTOCOL_VERSION}"
        for version in np.unique(rows["protocol_version"][~ours])
    ]
    rows = _newest_of_each_run(rows[ours])
    if not len(rows):
        return Decoded(strangers=tuple(strangers))
    return Decoded(
        _event(rows),
        dict(
            zip(
                zip(rows["host_id"].tolist(), rows["incarnation"].tolist(), strict=True),
                rows["beat"].tolist(),
                strict=True,
            )
        ),
        tuple(strangers),
        int(ours.sum()),
    )


def _newest_of_each_run(rows: npt.NDArray[np.void]) -> npt.NDArray[np.void]:
    """A former run that still speaks must not hide the readings of the present one."""
    if len(rows) < 2:
        return rows
    newest_first = rows[::-1]
    run = newest_first["host_id"].astype(np.uint64) << np.uint64(32)
    run |= newest_first["incarnation"] & np.uint64(0xFFFFFFFF)
    _, index = np.unique(run, return_index=True)
    return newest_first[index]


def _event(rows: npt.NDArray[np.void]) -> ReadingsReceived:
    return ReadingsReceived(
        host_id=rows["host_id"].astype(np.int64),
        incarnation=rows["incarnation"].astype(np.uint64),
        sequence=rows["sequence"].astype(np.uint64),
        status_sequence=rows["status_sequence"].astype(np.uint64),
        accepting=(rows["flags"] & ACCEPTING).astype(np.bool_),
        stale=rows["stale"].astype(np.uint32),
        usage=rows["usage"].astype(np.float64),
        limit=rows["limit"].astype(np.float64),
    )
