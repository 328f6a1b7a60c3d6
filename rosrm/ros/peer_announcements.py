"""Request for the announcements of all peers, because a new participant misses most replies.

Each peer replies once to the first announcement of a new participant. Fast DDS 2.14 sends that
announcement before the participant can receive. So the replies of the first 0.1 to 1 ms are lost,
and by default a peer announces itself again only after up to 3 s. Therefore this module announces a
second participant, which has no endpoints and has the address of the real one. Each peer replies to
that address, and the real participant receives the reply (docs/decisions/0009).
"""

from __future__ import annotations

import os
import socket
import struct
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from typing import Final

from rosrm.ros.graph_remains import open_sockets
from rosrm.runtime.addresses import reachable_addresses

#: DDSI-RTPS 2.3, 9.6.1 and 9.6.2: group and ports of discovery.
_GROUP: Final = "239.255.0.1"
_FIRST_PORT: Final = 7400
_PORTS_OF_A_DOMAIN: Final = 250
_FIRST_UNICAST: Final = 10
#: With LOCALHOST, rmw_fastrtps sends announcements to the ports of the first 32 participants.
_MOST_ON_THIS_MACHINE: Final = 32
_LOOPBACK: Final = "127.0.0.1"

#: Seconds after which the peers forget the announced participant.
_LEASE: Final = 1
#: DDSI-RTPS 2.3, 8.3 and 9.6.2.2: an announcement is a DATA submessage of the writer `_ANNOUNCER`.
_VERSION: Final = b"\x02\x03"
_UNKNOWN_VENDOR: Final = bytes(2)
_DATA: Final = 0x15
_LITTLE_ENDIAN_WITH_PAYLOAD: Final = 0x05
_ANY_READER: Final = bytes(4)
_ANNOUNCER: Final = b"\x00\x01\x00\xc2"
_PARTICIPANT: Final = b"\x00\x00\x01\xc1"
_PARAMETER_LIST: Final = b"\x00\x03\x00\x00"
#: The announced participant has only the writer and the reader of announcements.
_ENDPOINTS: Final = 0b11
_UDP_V4: Final = 1


def request_announcements(domain: int, environment: Mapping[str, str]) -> None:
    """Make all peers send their announcements to the participants of this process.

    Nothing is sent if no socket of this process has a default port, for example without UDP. No
    failure is reported: without the request, discovery only takes longer.

    Args:
        domain: ROS domain of the participants.
        environment: of this process.
    """
    if environment.get("ROS_DISCOVERY_SERVER"):
        return  # the discovery server sends its clients what they need
    with suppress(OSError):
        _request(domain, environment)


def _request(domain: int, environment: Mapping[str, str]) -> None:
    first = _FIRST_PORT + _PORTS_OF_A_DOMAIN * domain
    bound = set(_bound_ports())
    ports = [
        port for port in range(first + _FIRST_UNICAST, first + _PORTS_OF_A_DOMAIN, 2)
        if port in bound
    ]  # fmt: skip
    if not ports:
        return
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        if first in bound:
            _send_to_group(sender, (_GROUP, first), ports)
        elif environment.get("ROS_AUTOMATIC_DISCOVERY_RANGE", "").upper() == "LOCALHOST":
            message = announcement(_LOOPBACK, ports)
            for number in range(_MOST_ON_THIS_MACHINE):
                sender.sendto(message, (_LOOPBACK, first + _FIRST_UNICAST + 2 * number))


def _send_to_group(sender: socket.socket, group: tuple[str, int], ports: Sequence[int]) -> None:
    for address in reachable_addresses():
        try:
            sender.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, socket.inet_aton(address))
            sender.sendto(announcement(address, ports), group)
        except OSError:  # an interface that is down or gone, or has no multicast
            continue


def announcement(address: str, ports: Sequence[int]) -> bytes:
    """Return the announcement of a new participant without endpoints, at an IPv4 address."""
    # The prefix names no vendor, so that nothing takes it for a participant of Fast DDS.
    prefix = _UNKNOWN_VENDOR + os.urandom(10)
    locators = (struct.pack("<iI12x", _UDP_V4, port) + socket.inet_aton(address) for port in ports)
    payload = _PARAMETER_LIST + b"".join((
        _parameter(0x15, _VERSION + bytes(2)),  # PID_PROTOCOL_VERSION
        _parameter(0x16, _UNKNOWN_VENDOR + bytes(2)),  # PID_VENDORID
        _parameter(0x50, prefix + _PARTICIPANT),  # PID_PARTICIPANT_GUID
        _parameter(0x58, struct.pack("<I", _ENDPOINTS)),  # PID_BUILTIN_ENDPOINT_SET
        _parameter(0x02, struct.pack("<iI", _LEASE, 0)),  # PID_PARTICIPANT_LEASE_DURATION
        # PID_METATRAFFIC_UNICAST_LOCATOR
        *(_parameter(0x32, locator) for locator in locators),
        _parameter(0x01, b""),  # PID_SENTINEL
    ))  # fmt: skip
    # Flags, offset of the inline QoS, reader, writer, sequence number 1.
    data = struct.pack("<HH4s4siI", 0, 16, _ANY_READER, _ANNOUNCER, 0, 1) + payload
    header = b"RTPS" + _VERSION + _UNKNOWN_VENDOR + prefix
    return header + struct.pack("<BBH", _DATA, _LITTLE_ENDIAN_WITH_PAYLOAD, len(data)) + data


def _parameter(number: int, value: bytes) -> bytes:
    return struct.pack("<HH", number, len(value)) + value


def _bound_ports() -> Iterator[int]:
    """Yield the ports of this process's UDP sockets."""
    for number in open_sockets():
        try:
            copy = os.dup(number)
        except OSError:  # closed by another thread
            continue
        with socket.socket(fileno=copy) as one:
            if one.family == socket.AF_INET and one.type == socket.SOCK_DGRAM:
                yield one.getsockname()[1]
