"""Reservation of a process's UDP ports while the process exists only as an image.

Fast DDS takes the lowest free ports of a host. So the next participant there (a node, or a `rosrm`
that requests the restore) would take the ports of the process, and CRIU could not bind its sockets.
A reserved port is first bound without SO_REUSEADDR, like Fast DDS does it, and set to SO_REUSEADDR
only then. After that, only sockets with SO_REUSEADDR can share it: CRIU's, and multicast sockets.
"""

from __future__ import annotations

import contextlib
import json
import socket
import struct
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Final, NamedTuple

from rosrm.shortage import raise_shortage
from rosrm_criu.engine.open_files import descriptors

_TABLES: Final = (("udp", socket.AF_INET), ("udp6", socket.AF_INET6))


class Port(NamedTuple):
    """Address of a bound UDP socket.

    Attributes:
        family: AF_INET or AF_INET6.
        address: "0.0.0.0", ...
        port: its number.
    """

    family: int
    address: str
    port: int


def bound(pids: Iterable[int]) -> list[Port]:
    """Return the bound addresses of the UDP sockets of some processes."""
    found: set[Port] = set()
    for pid in pids:
        own = {one.target for one in descriptors([pid]) if one.target.startswith("socket:")}
        for name, family in _TABLES:
            found.update(port for inode, port in _table(pid, name, family) if inode in own)
    return sorted(found)


def _table(pid: int, name: str, family: int) -> Iterator[tuple[str, Port]]:
    """Yield each socket in the network of a process, by the name that its descriptors show."""
    try:
        lines = Path(f"/proc/{pid}/net/{name}").read_text().splitlines()[1:]
    except OSError as error:  # the process has ended, or the kernel has no IPv6
        raise_shortage(error)
        return
    for line in lines:
        words = line.split()
        address, port = words[1].split(":")
        yield f"socket:[{words[9]}]", Port(family, _address(address, family), int(port, 16))


def _address(text: str, family: int) -> str:
    """Return an address from the kernel's hexadecimal words, each in this machine's byte order."""
    words = [int(text[at : at + 8], 16) for at in range(0, len(text), 8)]
    return socket.inet_ntop(family, struct.pack(f"={len(words)}I", *words))


def write(path: Path, ports: Iterable[Port]) -> None:
    """Write ports to a file."""
    path.write_text(json.dumps([list(one) for one in ports]), encoding="utf-8")


def read(path: Path) -> list[Port]:
    """Return the ports in a file; none if it is missing or damaged."""
    try:
        return [Port(*one) for one in json.loads(path.read_text(encoding="utf-8"))]
    except (OSError, ValueError, TypeError) as error:
        if isinstance(error, OSError):
            raise_shortage(error)
        return []


def reserve(ports: Iterable[Port]) -> list[socket.socket]:
    """Return sockets that reserve these ports until they are closed; none for a port in use.

    Raises:
        OSError: no socket can be opened now; none stays open.
    """
    with contextlib.ExitStack() as undo:
        held = []
        for one in ports:
            try:
                held.append(undo.enter_context(_reserved(one)))
            except OSError as error:  # shared, or taken since: the restore will report it
                raise_shortage(error)
        undo.pop_all()
    return held


def _reserved(port: Port) -> socket.socket:
    one = socket.socket(port.family, socket.SOCK_DGRAM)
    try:
        if port.family == socket.AF_INET6:
            one.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_V6ONLY, 1)
        one.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 0)  # the socket is never read
        one.bind((port.address, port.port))
        one.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    except OSError:
        one.close()
        raise
    return one
