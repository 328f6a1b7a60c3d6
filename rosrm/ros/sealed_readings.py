"""Sealed readings: `resource_info` in messages of the same size, which decode fastest.

Slave and master write and read the CDR form of `rosrm_msgs/SealedReading` without rclpy. A test
compares this module with rclpy.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from typing import Final, NamedTuple

from rosrm.keys.links import OpenMessage
from rosrm.keys.sealing import FORMAT, OVERHEAD
from rosrm.keys.security import Peer
from rosrm.ros.reading_codec import HOST_ID, READING_BYTES
from rosrm.ros.sealed_codec import topic_channel
from rosrm_msgs import msg

#: Encapsulation (little-endian plain CDR, no options), host, format, counter, length of the body.
_HEAD: Final = struct.Struct("<4sIIQI")
#: Positions of the host's number and of the body in a message.
_HOST_ID: Final = slice(4, 8)
_BODY: Final = slice(_HEAD.size, None)
_CDR: Final = b"\x00\x01\x00\x00"
_BODY_BYTES: Final = READING_BYTES + OVERHEAD
_SIZE: Final = _HEAD.size + _BODY_BYTES
#: Seconds after a registration in which readings of a former run may still arrive.
_RENEWAL: Final = 5.0


class RegisteredSlave(NamedTuple):
    """Slave of a registered host.

    Attributes:
        peer: the slave.
        run: of the slave, at its registration.
        open: opens its readings.
        since: monotonic seconds of its registration.
    """

    peer: Peer
    run: bytes
    open: OpenMessage
    since: float

    @classmethod
    def of(cls, peer: Peer, run: bytes, channel: bytes, since: float) -> RegisteredSlave:
        """Return a slave whose registration was genuine; `channel` is that of the readings."""
        return cls(peer, run, peer.link.opener(channel, run), since)


def reading_channel(topic: str) -> bytes:
    """Return the channel of the readings; `topic` is fully qualified."""
    return topic_channel(msg.ResourceInfo, topic)


def seal_reading(master: Peer, channel: bytes, reading: bytes) -> bytes:
    """Return a serialised `SealedReading` with a serialised `ResourceInfo`."""
    done = master.link.seal(channel, reading, master.run)
    host = reading[HOST_ID]
    head = _HEAD.pack(_CDR, int.from_bytes(host, "little"), FORMAT, done.counter, _BODY_BYTES)
    return (head + done.body).ljust(_SIZE, b"\0")  # without keys, a body has no tag


def may_be_of_former_run(
    data: bytes, slave_of: Callable[[int], RegisteredSlave | None], now: float
) -> bool:
    """Return True if a reading that does not open may be of, or for, a former run.

    After a restart of the master, slaves send such readings until they notice the restart. And a
    master that was stopped may take the last readings of a former slave after the registration of
    the next one. So this is every reading of the right size that names a host that has not
    registered, or has just registered.
    """
    if len(data) != _SIZE:
        return False
    slave = slave_of(_HEAD.unpack_from(data)[1])
    return slave is None or now - slave.since < _RENEWAL


def open_reading(
    data: bytes, master_run: bytes, slave_of: Callable[[int], RegisteredSlave | None]
) -> bytes | None:
    """Return a serialised `ResourceInfo`; None: not genuine, or not of the host that it names."""
    if len(data) != _SIZE:
        return None
    _, host_id, form, counter, length = _HEAD.unpack_from(data)
    slave = slave_of(host_id) if form == FORMAT and length == _BODY_BYTES else None
    if slave is None:
        return None
    plain = slave.open(counter, data[_BODY], master_run)
    if plain is None or plain[HOST_ID] != data[_HOST_ID]:
        return None
    return plain[:READING_BYTES]
