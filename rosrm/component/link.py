"""Link between a component's process and the container that runs its node.

A link is a connection of a Unix socket, on which each side writes one line of JSON. The process
closes its half to have the node destroyed; its end closes the connection, too.
"""

from __future__ import annotations

import json
import os
import socket
import struct
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

#: Variables that distinguish the containers of one machine: cluster, host and ROS domain.
_PLACE: Final = ("ROSRM_MASTER", "ROSRM_HOST", "ROS_DOMAIN_ID")
#: Most bytes of a line; a parameter file is passed by its path.
_LONGEST: Final = 1 << 20
#: Beginning of the line by which a component's process says why it has failed: its last one.
FAULT: Final = "rosrm.component: "
#: Exit code after such a line.
FAILED: Final = 1
#: Name that the kernel shows for the process of a loaded component (at most 15 characters).
_TITLE: Final = "node in "
_CREDENTIALS: Final = struct.Struct("3i")


def address(container: str, environment: Mapping[str, str]) -> str:
    """Return the abstract address of a container on a host; it ends with the container.

    Args:
        container: name of the container on its host.
        environment: of the container or of a component's process.
    """
    from hashlib import sha256  # noqa: PLC0415 - OpenSSL, 1 MiB, only where components are used

    place = [str(os.getuid()), *(environment.get(name, "") for name in _PLACE), container]
    digest = sha256(json.dumps(place).encode()).hexdigest()
    return f"\0rosrm-container-{digest[:32]}"


def is_own(peer: socket.socket) -> bool:
    """Return True if the other side runs as the same user: an abstract address has no rights."""
    given = peer.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _CREDENTIALS.size)
    _, user, _ = _CREDENTIALS.unpack(given)
    return bool(user == os.getuid())


def send(link: socket.socket, message: Mapping[str, Any]) -> None:
    """Send a message."""
    link.sendall(json.dumps(message).encode() + b"\n")


def receive(link: socket.socket) -> dict[str, Any] | None:
    """Return the message of the other side; None: it has closed the link, or sent no message."""
    with link.makefile("rb") as lines:
        line = lines.readline(_LONGEST)
    try:
        message = json.loads(line) if line.endswith(b"\n") else None
    except (ValueError, RecursionError):
        return None
    return message if isinstance(message, dict) else None


def show_container(pid: int) -> None:
    """Show in the name of this process that its node runs in another one."""
    Path("/proc/self/comm").write_text(f"{_TITLE}{pid}", encoding="ascii")


def container_of(pid: int, proc: str = "/proc") -> int | None:
    """Return the pid of the container that runs a process's node; None: the process itself does."""
    try:
        name = Path(proc, str(pid), "comm").read_text(encoding="ascii").strip()
    except (OSError, ValueError):  # it has ended, or has another name
        return None
    number = name.removeprefix(_TITLE)
    return int(number) if number != name and number.isdecimal() else None


def fault_in(lines: Sequence[str]) -> str:
    """Return why a component's process has failed, from its last log lines; "": not known."""
    last = lines[-1] if lines else ""
    return last.removeprefix(FAULT) if last.startswith(FAULT) else ""
