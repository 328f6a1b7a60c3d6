"""Packets by which two slaves measure the round trip of the link between them.

A probe has the number of its sender's host and a random number; the echo has that number and the
time that it has waited at the other slave. Both end with a tag of keyed BLAKE2b. Its key is derived
from the key of the probed host, so that a stranger can forge neither, and the probed slave stores
nothing. A recorded probe yields one more echo of the same size, which its sender ignores.
"""

from __future__ import annotations

import hashlib
import hmac
import struct
from collections.abc import Callable
from typing import Final, NamedTuple

#: Bytes of the random number of a probe.
NONCE_BYTES: Final = 16

_TAG_BYTES: Final = 16
_PERSON: Final = b"rosrm link 1"
#: Version and kind, host number of the prober, random number, and nanoseconds of the wait.
_FORM: Final = struct.Struct("<4sI16sQ")
_PROBE: Final = b"rL1p"
_ECHO: Final = b"rL1e"
#: Bytes of each packet.
PACKET_BYTES: Final = _FORM.size + _TAG_BYTES


class Packet(NamedTuple):
    """A packet whose tag is not checked yet.

    Attributes:
        is_echo: it answers a probe.
        host_id: number of the prober's host.
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
    """Return a received packet; None: it is not genuine.

    Args:
        key_of: returns the key by which a packet must be tagged; None: there is none.
    """
    if len(data) != PACKET_BYTES:
        return None
    kind, host_id, nonce, wait = _FORM.unpack_from(data)
    if kind not in (_PROBE, _ECHO):
        return None
    packet = Packet(kind == _ECHO, host_id, nonce, wait)
    key = key_of(packet)
    if key is None or not hmac.compare_digest(_tag(key, data[:-_TAG_BYTES]), data[-_TAG_BYTES:]):
        return None
    return packet


def _tagged(key: bytes, content: bytes) -> bytes:
    return content + _tag(key, content)


def _tag(key: bytes, content: bytes) -> bytes:
    return hashlib.blake2b(content, key=key, digest_size=_TAG_BYTES, person=_PERSON).digest()
