"""Encoder of `resource_info`, and the layout of the message.

All messages have the same size, so their CDR form is a C struct behind a header of four bytes. A
test compares every field with rclpy's own serialisation. The master's decoder is a separate module,
because it imports numpy and the master's events, which would cost each slave memory.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from rosrm.model.values import RESOURCE_SLOTS
from rosrm.version import PROTOCOL_VERSION

#: Encapsulation: little-endian plain CDR, no options.
_HEADER: Final = b"\x00\x01\x00\x00"
#: The header, the numbers, then the usages and the limits, each sequence after its length.
_FORM: Final = struct.Struct(f"<4sHHI5Q3I I{RESOURCE_SLOTS}f I{RESOURCE_SLOTS}f")

#: Bytes of each serialised message.
READING_BYTES: Final = _FORM.size
#: Where a serialised message has the number of its host.
HOST_ID: Final = slice(8, 12)

ACCEPTING: Final = 1
#: Bits 8 to 15 of the flags: cycles without news since the message before.
QUIET_SHIFT: Final = 8
MOST_QUIET: Final = 255


@dataclass(slots=True)
class Reading:
    """Fields of a `ResourceInfo`, described in its message file."""

    protocol_version: int = PROTOCOL_VERSION
    flags: int = 0
    host_id: int = 0
    incarnation: int = 0
    sequence: int = 0
    beat: int = 0
    master_beat: int = 0
    status_sequence: int = 0
    processes: int = 0
    present: int = 0
    stale: int = 0
    usage: Sequence[float] = (0.0,) * RESOURCE_SLOTS
    limit: Sequence[float] = (0.0,) * RESOURCE_SLOTS


def flags(*, accepting: bool, quiet: int) -> int:
    """Return the flags of a message.

    Args:
        accepting: the slave is under all its limits and accepts work.
        quiet: cycles without news since the message before, at most `MOST_QUIET`.
    """
    return (ACCEPTING if accepting else 0) | quiet << QUIET_SHIFT


def encode(reading: Reading) -> bytes:
    """Return the serialised message."""
    return _FORM.pack(
        _HEADER, reading.protocol_version, reading.flags, reading.host_id, reading.incarnation,
        reading.sequence, reading.beat, reading.master_beat, reading.status_sequence,
        reading.processes, reading.present, reading.stale,
        RESOURCE_SLOTS, *reading.usage, RESOURCE_SLOTS, *reading.limit,
    )  # fmt: skip
