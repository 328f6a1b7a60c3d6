"""Marks as releases before protocol version 8 have written them into snapshots."""

from __future__ import annotations

import struct

from rosrm_msgs.msg import StateMark


def old_mark(mark: StateMark) -> bytes:
    """Return the bytes of a mark in the earlier form: a CRC for each part, and no positions."""
    out = bytearray()

    def number(kind: str, *values: int) -> None:
        for value in values:
            out.extend(bytes(-len(out) % struct.calcsize(kind)) + struct.pack(f"<{kind}", value))

    def text(value: str) -> None:
        number("I", len(value.encode()) + 1)
        out.extend(value.encode() + b"\0")

    number("H", mark.protocol_version)
    number("Q", mark.run, mark.sequence)
    number("B", mark.last)
    number("I", len(mark.parts))
    for part in mark.parts:
        text(part.topic)
        text(part.type)
        number("Q", part.size)
        number("I", 0xDEADBEEF)
    number("I", len(mark.inputs))
    for one in mark.inputs:
        text(one.topic)
        number("I", one.publishers, len(one.covered))
        number("q", *one.covered)
    number("I", len(mark.outputs))
    for output in mark.outputs:
        text(output.topic)
        number("I", output.subscriptions)
    number("I", len(mark.timers_due))
    number("q", *mark.timers_due)
    return b"\x00\x01\x00\x00" + bytes(out)
