"""ROS traffic confined to this machine, for clusters of several hosts on it in demos and tests.

ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST confines traffic on any machine, with two drawbacks. Only
the first 32 participants of a domain discover each other. And nodes always use shared memory, in
which killed processes leave segments (docs/decisions/0015). A network namespace in which only
loopback has an address has neither drawback.
"""

from __future__ import annotations

import ctypes
import fcntl
import os
import socket
import struct
from pathlib import Path
from typing import Final

import psutil

from rosrm.model.ros_settings import RosSettings

#: Constants of linux/sched.h, linux/sockios.h and linux/if.h.
_CLONE_NEWNET: Final = 0x40000000
_SIOCSIFFLAGS: Final = 0x8914
_IFF_UP: Final = 0x1
#: Bits of CAP_SYS_ADMIN, for a new namespace, and of CAP_NET_ADMIN, to bring up its loopback.
_NEEDED: Final = 1 << 21 | 1 << 12


def settings_on_this_machine(domain: int | None = None) -> RosSettings:
    """Return the ROS settings that keep all traffic on this machine."""
    if _is_alone():
        return RosSettings(domain=domain, discovery_range="subnet", transports="UDPv4")
    return RosSettings(domain=domain, discovery_range="localhost")


def enter_private_network() -> bool:
    """Move this thread and its future children into a network namespace with loopback alone.

    The namespace ends with its last process.

    Returns:
        True on success; False without the capabilities CAP_SYS_ADMIN and CAP_NET_ADMIN.
    """
    if _capabilities() & _NEEDED != _NEEDED:
        return False
    if ctypes.CDLL(None, use_errno=True).unshare(_CLONE_NEWNET) != 0:
        return False
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as any_socket:
        request = struct.pack("16sh14x", b"lo", _IFF_UP)
        fcntl.ioctl(any_socket, _SIOCSIFFLAGS, request)
    os.environ.update(settings_on_this_machine().environment())
    return True


def _capabilities() -> int:
    """Return the effective capabilities of this process as a bit mask."""
    status = Path("/proc/self/status").read_text(encoding="ascii", errors="replace")
    (line,) = (line for line in status.splitlines() if line.startswith("CapEff:"))
    return int(line.split()[1], 16)


def _is_alone() -> bool:
    """Return True if only loopback has an IPv4 address."""
    interfaces = {
        name
        for name, addresses in psutil.net_if_addrs().items()
        if any(address.family == socket.AF_INET for address in addresses)
    }
    return interfaces == {"lo"}
