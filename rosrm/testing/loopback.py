"""ROS that does not leave this machine, for clusters of several hosts on one: demos and tests.

ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST keeps it here on any machine, at a price: the first 32
participants of a domain find each other, and nodes always use shared memory, with what killed
processes leave there (docs/decisions/0015). In a network namespace where nothing but
loopback has an address neither holds.
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

#: Of linux/sched.h, linux/sockios.h and linux/if.h.
_CLONE_NEWNET: Final = 0x40000000
_SIOCSIFFLAGS: Final = 0x8914
_IFF_UP: Final = 0x1
#: Bits of CAP_SYS_ADMIN, to make a network, and of CAP_NET_ADMIN, to bring loopback up in it.
_NEEDED: Final = 1 << 21 | 1 << 12


def settings_on_this_machine(domain: int | None = None) -> RosSettings:
    """How to join ROS so that nothing leaves this machine."""
    if _is_alone():
        return RosSettings(domain=domain, discovery_range="subnet", transports="UDPv4")
    return RosSettings(domain=domain, discovery_range="localhost")


def enter_private_network() -> bool:
    """Move this thread, and all that it starts from now on, into a network of loopback alone.

    The network ends with the last process in it.

    Returns:
        Whether it was allowed: the capabilities CAP_SYS_ADMIN and CAP_NET_ADMIN are needed.
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
    """The effective ones of this process, as bits."""
    status = Path("/proc/self/status").read_text(encoding="ascii", errors="replace")
    (line,) = (line for line in status.splitlines() if line.startswith("CapEff:"))
    return int(line.split()[1], 16)


def _is_alone() -> bool:
    """Whether no interface but loopback has an address."""
    interfaces = {
        name
        for name, addresses in psutil.net_if_addrs().items()
        if any(address.family == socket.AF_INET for address in addresses)
    }
    return interfaces == {"lo"}
