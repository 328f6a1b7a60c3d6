"""CDR form of `rosrm_msgs/Sealed`, written and read without rclpy's message objects.

rclpy would copy the body of a message four more times. For a state of 64 MiB the copies take 0.2 s,
in which neither node of a handoff is active. A test compares this module with rclpy.
"""

from __future__ import annotations

import struct
from typing import Any, Final, NamedTuple

from rosrm.keys.sealing import RUN_BYTES, channel_of

#: Encapsulation: little-endian plain CDR, no options.
_HEADER: Final = b"\x00\x01\x00\x00"
#: Most letters of a principal. A ticket is the longest, because it contains two names.
MOST_LETTERS: Final = 512
#: Format and length of the principal, before its letters.
_FIRST: Final = struct.Struct("<B3xI")
#: Generation, then the runs of sender and receiver, each behind its length.
_MIDDLE: Final = struct.Struct(f"<II{RUN_BYTES}sI{RUN_BYTES}s")
#: Counter and length of the body.
_LAST: Final = struct.Struct("<QI")


class Envelope(NamedTuple):
    """Fields of a message in `rosrm_msgs/Sealed`."""

    format: int
    principal: str
    generation: int
    run: bytes
    receiver_run: bytes
    counter: int
    body: bytes | memoryview


def type_name(kind: Any, part: str = "") -> str:
    """Return "rosrm_msgs/srv/Submit_Request" for the request type of `Submit`."""
    package, folder = kind.__module__.split(".")[:2]
    return f"{package}/{folder}/{kind.__name__}{part}"


def topic_channel(message_type: Any, name: str) -> bytes:
    """Return the channel of a topic."""
    return channel_of(name, type_name(message_type))


def encode(envelope: Envelope) -> bytes:
    """Return the CDR form of a message."""
    principal = envelope.principal.encode() + b"\0"
    first = _FIRST.pack(envelope.format, len(principal)) + principal
    middle = _MIDDLE.pack(
        envelope.generation, RUN_BYTES, envelope.run, RUN_BYTES, envelope.receiver_run
    )
    head = first + _padding(first, 4) + middle
    last = _LAST.pack(envelope.counter, len(envelope.body))
    return b"".join((_HEADER, head, _padding(head, 8), last, envelope.body))


def _padding(before: bytes, alignment: int) -> bytes:
    return bytes(-len(before) % alignment)


def decode(data: bytes) -> Envelope | None:
    """Return the fields of a message, without copying its body; None: it is malformed."""
    if data[:2] != _HEADER[:2]:
        return None
    content = memoryview(data)[len(_HEADER) :]
    try:
        kind, letters = _FIRST.unpack_from(content)
        if letters > MOST_LETTERS:
            return None
        end = _FIRST.size + letters
        principal = bytes(content[_FIRST.size : end]).rstrip(b"\0").decode()
        end += -end % 4
        generation, run_bytes, run, receiver_bytes, receiver_run = _MIDDLE.unpack_from(content, end)
        if not run_bytes == receiver_bytes == RUN_BYTES:
            return None
        end += _MIDDLE.size
        end += -end % 8
        counter, size = _LAST.unpack_from(content, end)
    except (struct.error, UnicodeDecodeError):
        return None
    body = content[end + _LAST.size :][:size]
    if len(body) != size:
        return None
    return Envelope(kind, principal, generation, run, receiver_run, counter, body)
