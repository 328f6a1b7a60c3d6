"""Encoder of `resource_info`, and the layout of the message.

The message has a fixed size, so its CDR form is a C struct behind a header of four bytes. A test
compares every field with rclpy's own serialisation. The master's decoder is a module of its own,
because it imports the master's events, which would cost each slave memory.
"""

from __future__ import annotations

from typing import Final

import numpy as np
import numpy.typing as npt

from rosrm.model.values import RESOURCE_SLOTS

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

#: Where a serialised message has the number of its host.
HOST_ID: Final = slice(8, 12)

ACCEPTING: Final = 1
#: Bits 8 to 15 of the flags: cycles without news since the message before.
QUIET_SHIFT: Final = 8
MOST_QUIET: Final = 255


def flags(*, accepting: bool, quiet: int) -> int:
    """Return the flags of a message.

    Args:
        accepting: the slave is under all its limits and accepts work.
        quiet: cycles without news since the message before, at most `MOST_QUIET`.
    """
    return (ACCEPTING if accepting else 0) | quiet << QUIET_SHIFT


def encode(row: npt.NDArray[np.void]) -> bytes:
    """Return the serialised message of one record of `LAYOUT` (shape ())."""
    row["header"] = _HEADER
    raw = bytearray(row.tobytes())
    raw[:4] = _HEADER  # numpy strips trailing zeros of a byte string
    return bytes(raw)
