"""CDR form of `rosrm_msgs/Signed`, read without rclpy's message objects.

Each slave receives some of these messages a second from the master. A test compares this module
with rclpy.
"""

from __future__ import annotations

import struct
from typing import Final, NamedTuple

from rosrm.keys.sealing import FORMAT, RUN_BYTES
from rosrm.keys.security import SIGNATURE_BYTES
from rosrm.ros.bounds import MOST_ENTRIES

#: Encapsulation (little-endian plain CDR), format, run, counter, signature and length of the body.
_HEAD: Final = struct.Struct(f"<2s2xB3xI{RUN_BYTES}sQI{SIGNATURE_BYTES}sI")
_ENCAPSULATION: Final = b"\0\1"
_FIXED: Final = (_ENCAPSULATION, FORMAT, RUN_BYTES, SIGNATURE_BYTES)
_COUNTER: Final = struct.Struct("<Q")


class SignedMessage(NamedTuple):
    """Fields of a message in `rosrm_msgs/Signed`, of the format of this version."""

    run: bytes
    counter: int
    signature: bytes
    body: bytes

    def content(self, channel: bytes) -> bytes:
        """Return the bytes that the signature covers."""
        return signed_content(channel, self.run, self.counter, self.body)


def signed_content(channel: bytes, run: bytes, counter: int, body: bytes) -> bytes:
    """Return the bytes that the signature of a message covers."""
    return channel + run + _COUNTER.pack(counter) + body


def decode(data: bytes) -> SignedMessage | None:
    """Return the fields of a message; None: it is malformed, too large or of another format."""
    if len(data) < _HEAD.size:
        return None
    encapsulation, form, run_bytes, run, counter, signature_bytes, signature, size = (
        _HEAD.unpack_from(data)
    )
    if (encapsulation, form, run_bytes, signature_bytes) != _FIXED or size > MOST_ENTRIES:
        return None
    body = data[_HEAD.size :][:size]
    return SignedMessage(run, counter, signature, body) if len(body) == size else None
