"""Marks in snapshots, also those of earlier protocol versions."""

from __future__ import annotations

import struct
from array import array
from typing import Final

from rclpy.serialization import deserialize_message

from rosrm_msgs.msg import CoveredInput, MatchedOutput, StateMark, StatePart

#: First protocol version with BLAKE2b digests of parts, and with the positions of covered messages.
POSITIONS: Final = 8
#: Bytes before the content: the encapsulation, which is little-endian plain CDR.
_HEADER: Final = 4


def decoded_mark(data: bytes) -> StateMark:
    """Return the mark in CDR bytes.

    Raises:
        Exception: the bytes are no mark; rclpy raises several kinds.
    """
    version = _OldCdr(data).number("H")
    if version >= POSITIONS:
        return deserialize_message(data, StateMark)
    return _decoded_old(_OldCdr(data))


def _decoded_old(cdr: _OldCdr) -> StateMark:
    mark = StateMark(
        protocol_version=cdr.number("H"), run=cdr.number("Q"), sequence=cdr.number("Q"),
        last=bool(cdr.number("B")),
    )  # fmt: skip
    for _ in range(cdr.number("I")):
        mark.parts.append(StatePart(topic=cdr.text(), type=cdr.text(), size=cdr.number("Q")))
        cdr.number("I")  # a CRC-32
    for _ in range(cdr.number("I")):
        one = CoveredInput(topic=cdr.text(), publishers=cdr.number("I"), covered=cdr.times())
        one.processed = len(one.covered)
        mark.inputs.append(one)
    for _ in range(cdr.number("I")):
        mark.outputs.append(MatchedOutput(topic=cdr.text(), subscriptions=cdr.number("I")))
    mark.timers_due = cdr.times()
    return mark


class _OldCdr:
    """Reader of the fields of one message."""

    def __init__(self, data: bytes) -> None:
        self._content = memoryview(data)[_HEADER:]
        self._at = 0

    def number(self, kind: str) -> int:
        """Return the next number; `kind` is its letter in `struct`."""
        size = struct.calcsize(kind)
        self._at += -self._at % size
        (value,) = struct.unpack_from(f"<{kind}", self._content, self._at)
        self._at += size
        return int(value)

    def text(self) -> str:
        size = self.number("I")
        self._at += size
        return bytes(self._content[self._at - size : self._at]).rstrip(b"\0").decode()

    def times(self) -> array[int]:
        return array("q", (self.number("q") for _ in range(self.number("I"))))
