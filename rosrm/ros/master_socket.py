"""Socket of the master for sealed requests from its own machine, in place of DDS.

One connection carries one request and its answer. Each is a frame: its length (4 bytes, little
endian), then for a request the name of the service and a NUL, then the CDR form of the envelope.
The socket is abstract, so that it exists only in the network namespace of the master, as DDS over
loopback, and leaves no file behind. Any program on the machine can bind the name first. It can then
delay requests, but not read or forge them, because messages are sealed. With `security: none` they
are not, so there is no socket. This module imports no rclpy.
"""

from __future__ import annotations

import select
import socket
import struct
from collections.abc import Callable
from typing import TYPE_CHECKING, Final

from rosrm import clocks
from rosrm.keys.hashing import digest_of
from rosrm.model.ros_settings import RosSettings
from rosrm.ros.sealed_codec import Envelope, decode, encode

if TYPE_CHECKING:
    from rosrm.keys.security import Security

#: Most bytes of a request; a larger one is sent over DDS.
MOST_REQUEST: Final = 1 << 20
#: Most bytes of an answer: the body of a sealed message and its envelope.
_MOST_ANSWER: Final = (1 << 24) + (1 << 12)
_LENGTH: Final = struct.Struct("<I")
#: Most bytes that one system call reads.
_PIECE: Final = 1 << 16
#: Shortest time-out in seconds, because 0 makes the socket non-blocking.
_SHORTEST: Final = 0.001
#: Seconds between two calls of `on_wait`.
_REPORT_EVERY: Final = 0.1


def address(settings: RosSettings, security: Security) -> str:
    """Return the address of the socket; "": there is none, because of `security: none`.

    The address differs for masters that DDS would keep apart, and for clusters with other keys.
    """
    domain, others = settings.socket_name()
    apart = digest_of(others.encode(), 16, b"rosrm socket", security.cluster)
    return f"\0{domain}{apart.hex()}" if security.cluster else ""


def connect(at: str) -> socket.socket | None:
    """Return a connection to the master; None: it does not listen here, or is too busy."""
    if not at:
        return None
    connection = socket.socket(socket.AF_UNIX)
    try:
        connection.settimeout(_REPORT_EVERY)  # a full queue raises an error then
        connection.connect(at)
    except OSError:
        connection.close()
        return None
    return connection


def request_of(service: str, envelope: Envelope) -> bytes:
    """Return the content of the frame of a request."""
    return service.encode() + b"\0" + encode(envelope)


def service_and_envelope(content: bytes) -> tuple[str, Envelope | None]:
    """Return the service and the envelope of a request; None: the envelope is malformed."""
    service, _, form = content.partition(b"\0")
    return service.decode("ascii", "replace"), decode(form)


def ask(
    connection: socket.socket, request: bytes, until: float, on_wait: Callable[[float], None] | None
) -> Envelope | None:
    """Send a request; return its answer, None: no answer came until then (monotonic seconds).

    `on_wait` is called about every 0.1 s with the seconds since the request; an exception that it
    raises ends the wait.
    """
    began, answering = clocks.boot_time(), select.poll()
    answering.register(connection, select.POLLIN)
    try:
        send(connection, request, until)
        while not answering.poll(_REPORT_EVERY * 1e3):
            if clocks.boot_time() >= until:
                return None
            if on_wait is not None:
                on_wait(clocks.boot_time() - began)
        return decode(receive(connection, _MOST_ANSWER, until))
    except OSError:
        return None


def send(connection: socket.socket, content: bytes, until: float) -> None:
    """Send a frame; raise `OSError` if that has not ended at `until` (monotonic seconds)."""
    connection.settimeout(max(_SHORTEST, until - clocks.boot_time()))
    connection.sendall(_LENGTH.pack(len(content)) + content)


def receive(connection: socket.socket, most: int, until: float) -> bytes:
    """Return the content of a frame, of at most `most` bytes.

    Raises:
        OSError: the frame is longer, the connection ended before, or `until` has passed.
    """
    data, size = bytearray(), _LENGTH.size
    while len(data) < size:
        connection.settimeout(max(_SHORTEST, until - clocks.boot_time()))
        part = connection.recv(_PIECE)
        if not part:
            raise ConnectionError("the other side has closed the connection")
        data += part
        if len(data) >= _LENGTH.size:
            size = _LENGTH.size + _LENGTH.unpack_from(data)[0]
        if max(size, len(data)) > _LENGTH.size + most:
            raise ConnectionError(f"a frame of {size} bytes; at most {most}")
    return bytes(memoryview(data)[_LENGTH.size : size])
