"""What of ROS is still in a process that has left the graph."""

from __future__ import annotations

from pathlib import Path
from typing import Final

#: How Fast DDS names its threads, and its files in shared memory.
_THREADS: Final = "dds."
_SHARED: Final = "/dev/shm/fastrtps_"  # noqa: S108 - not a file of ours
#: Standard input, output and error are the supervisor's, and whoever restores takes care of them.
_STANDARD: Final = frozenset({"0", "1", "2"})


def what_is_left() -> str:
    """Why this process cannot be dumped as it is, and what to do; "": nothing is in the way."""
    threads = sorted(one for one in _thread_names() if one.startswith(_THREADS))
    if threads:
        return (
            f"ROS is still at work after the node was destroyed (threads {', '.join(threads)}): "
            f"something holds another node or an entity of this one; destroy it in leave()"
        )
    files = _open_files()
    sockets = [number for number, target in files.items() if target.startswith("socket:")]
    if sockets:
        return f"the sockets {', '.join(sockets)} are open: close them in leave()"
    shared = [target for target in files.values() if target.startswith(_SHARED)]
    if shared:
        return (
            f"Fast DDS left {', '.join(shared)} open: set FASTDDS_BUILTIN_TRANSPORTS=UDPv4 in the "
            f"environment of this process, or leave transports out of its profile"
        )
    return ""


def _thread_names() -> list[str]:
    names = []
    for task in Path("/proc/self/task").iterdir():
        try:
            names.append((task / "comm").read_text(encoding="utf-8", errors="replace").strip())
        except OSError:  # it has just ended
            continue
    return names


def _open_files() -> dict[str, str]:
    """By number, but for the standard three."""
    found = {}
    for one in Path("/proc/self/fd").iterdir():
        if one.name not in _STANDARD:
            try:
                found[one.name] = str(one.readlink())
            except OSError:  # the one that lists them
                continue
    return found
