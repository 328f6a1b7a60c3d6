"""ROS resources left in a process whose nodes and context are gone."""

from __future__ import annotations

import os
import socket
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Final

#: Prefixes of Fast DDS's threads and of its files in shared memory.
_THREADS: Final = "dds."
_OF_SHARED: Final = "dds.shm"
_SHARED: Final = "/dev/shm/fastrtps_"  # noqa: S108 - not a file of ours
#: Standard input, output and error belong to the supervisor; the restore replaces them.
_STANDARD: Final = frozenset({0, 1, 2})


def what_is_left() -> str:
    """Return the obstacle to a dump of this process, with its remedy; "": there is none."""
    threads = sorted(one for one in _thread_names() if one.startswith(_THREADS))
    if any(thread.startswith(_OF_SHARED) for thread in threads):
        return (
            f"Fast DDS uses shared memory (threads {', '.join(threads)}), whatever its "
            f"transports are set to, as with ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST: start the "
            f"slaves with SUBNET, in a domain of their own, or destroy in leave() all other ROS "
            f"entities of this process"
        )
    if threads:
        return (
            f"ROS is still at work after the node was destroyed (threads {', '.join(threads)}): "
            f"something holds another node or an entity of this one; destroy it in leave()"
        )
    sockets = open_sockets()
    if sockets:
        numbers = ", ".join(map(str, sorted(sockets)))
        return f"sockets are open (file descriptors {numbers}): close them in leave()"
    shared = [target for target in _open_files().values() if target.startswith(_SHARED)]
    if shared:
        return (
            f"Fast DDS left {', '.join(shared)} open: set FASTDDS_BUILTIN_TRANSPORTS=UDPv4 in the "
            f"environment of this process, or leave transports out of its profile"
        )
    return ""


def open_sockets() -> dict[int, str]:
    """Return open sockets by file descriptor; a value `socket:[INODE]` is unique."""
    return {number: one for number, one in _open_files().items() if one.startswith("socket:")}


def close_leaked(sockets: Mapping[int, str]) -> None:
    """Close those sockets that are still open and unused: not bound, not connected.

    Fast DDS 2.14 leaves one for each network interface, from its query of the MAC address. The
    caller names the sockets that were opened while Fast DDS was at work.
    """
    now = open_sockets()
    for number, one in sockets.items():
        if now.get(number) == one and _is_unused(number):
            os.close(number)


def _is_unused(number: int) -> bool:
    with socket.socket(fileno=os.dup(number)) as one:
        is_udp = one.family == socket.AF_INET and one.type == socket.SOCK_DGRAM
        return is_udp and one.getsockname()[1] == 0


def _thread_names() -> Iterable[str]:
    for task in Path("/proc/self/task").iterdir():
        try:
            yield (task / "comm").read_text(encoding="utf-8", errors="replace").strip()
        except OSError:  # the thread has just ended
            continue


def _open_files() -> dict[int, str]:
    """Return open files by file descriptor, without the standard three."""
    found = {}
    for one in Path("/proc/self/fd").iterdir():
        if int(one.name) not in _STANDARD:
            try:
                found[int(one.name)] = str(one.readlink())
            except OSError:  # the descriptor of the listing itself
                continue
    return found
