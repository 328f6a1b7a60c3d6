"""Packets with which two slaves measure the round trip of the link between them.

A probe contains the number of the probing host and a random number. The echo contains both numbers,
and the time between the arrival of the probe and the sending of the echo. Each packet ends with a
tag of keyed BLAKE2b. The key is derived from the key of the probed host. So a sender without that
key can forge no packet, and the probed slave stores no keys of other hosts. A recorded probe that
is sent again yields one more echo of the same size, which the probing slave ignores.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from typing import Final, NamedTuple

from rosrm.keys.hashing import are_equal, digest_of

#: Bytes of the random number of a probe.
NONCE_BYTES: Final = 16

_TAG_BYTES: Final = 16
_PERSON: Final = b"rosrm link 1"
#: Version and kind, number of the probing host, random number, and nanoseconds of the wait.
_FORM: Final = struct.Struct("<4sI16sQ")
_PROBE: Final = b"rL1p"
_ECHO: Final = b"rL1e"
#: Bytes of each packet.
PACKET_BYTES: Final = _FORM.size + _TAG_BYTES


class Packet(NamedTuple):
    """A packet whose tag is not checked yet.

    Attributes:
        is_echo: True for an echo, False for a probe.
        host_id: number of the probing host.
        nonce: random number of the probe.
        wait: nanoseconds between the arrival of the probe and the sending of its echo.
    """

    is_echo: bool
    host_id: int
    nonce: bytes
    wait: int


def probe(key: bytes, host_id: int, nonce: bytes) -> bytes:
    """Return a probe."""
    return _tagged(key, _FORM.pack(_PROBE, host_id, nonce, 0))


def echo(key: bytes, received: Packet, wait: int) -> bytes:
    """Return the echo of a probe."""
    return _tagged(key, _FORM.pack(_ECHO, received.host_id, received.nonce, max(0, wait)))


def opened(data: bytes, key_of: Callable[[Packet], bytes | None]) -> Packet | None:
    """Return a received packet; None if the packet is not genuine.

    Args:
        key_of: returns the key with which a packet must be tagged; None to drop the packet.
    """
    if len(data) != PACKET_BYTES:
        return None
    kind, host_id, nonce, wait = _FORM.unpack_from(data)
    if kind not in (_PROBE, _ECHO):
        return None
    packet = Packet(kind == _ECHO, host_id, nonce, wait)
    key = key_of(packet)
    if key is None or not are_equal(_tag(key, data[:-_TAG_BYTES]), data[-_TAG_BYTES:]):
        return None
    return packet


def _tagged(key: bytes, content: bytes) -> bytes:
    return content + _tag(key, content)


def _tag(key: bytes, content: bytes) -> bytes:
    return digest_of(content, _TAG_BYTES, _PERSON, key)
