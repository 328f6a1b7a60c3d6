"""IPv4 addresses of the network interfaces of this machine."""

from __future__ import annotations

import contextlib
import fcntl
import socket
import struct
from typing import Final

#: ioctl that returns the IPv4 address of an interface.
_SIOCGIFADDR: Final = 0x8915
_REQUEST: Final = struct.Struct("256s")


def addresses() -> dict[str, str]:
    """Return the IPv4 address of each interface that has one."""
    found = {}
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        for _, name in socket.if_nameindex():
            with contextlib.suppress(OSError):  # it has no address
                answer = fcntl.ioctl(probe.fileno(), _SIOCGIFADDR, _REQUEST.pack(name.encode()))
                found[name] = socket.inet_ntoa(answer[20:24])
    return found


def reachable_addresses() -> tuple[str, ...]:
    """Return the IPv4 addresses at which other hosts may reach this one; loopback if none can."""
    found = dict.fromkeys(addresses().values())
    outer = [one for one in found if not one.startswith("127.")]
    return tuple(outer or found)
