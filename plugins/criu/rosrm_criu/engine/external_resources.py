"""External resources of a process tree: pipes, Unix sockets and debuggers outside the dump.

CRIU dumps most of them without an error. Later the restore fails, or the restored process finds no
peer.
"""

from __future__ import annotations

import os
import socket
import struct
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Final

from rosrm.shortage import raise_shortage
from rosrm.supervisor.procfs import everyone
from rosrm_criu.engine.open_files import Descriptor, descriptors

#: Constants of linux/netlink.h, linux/sock_diag.h and linux/unix_diag.h.
_NETLINK_SOCK_DIAG: Final = 4
_SOCK_DIAG_BY_FAMILY: Final = 20
_REQUEST_ALL: Final = 0x301
_SHOW_PEER: Final = 4
_PEER: Final = 2
_DONE: Final = 3
_ERROR: Final = 2

#: Prefix of Fast DDS's files in shared memory.
_OF_FAST_DDS: Final = "/dev/shm/fastrtps_"  # noqa: S108 - not a file of ours


def outward(pids: Iterable[int]) -> str:
    """Describe an external resource of a process tree; return "" if there is none.

    Args:
        pids: all processes of the tree.
    """
    inside = list(pids)
    for pid in inside:
        holder = tracer(pid)
        if holder:
            return f"pid {pid} ({program(pid)}) is held by pid {holder} ({program(holder)})"
    held = [one for one in descriptors(inside) if one.target.startswith(("pipe:", "socket:"))]
    for one in _half_pipes(held):
        other = _holder_outside(one.target, inside)
        if other:
            return f"{_named(one)} is a pipe that it shares with {other}"
    peers = _unix_peers() if any(one.target.startswith("socket:") for one in held) else {}
    own = {_inode(one) for one in held}
    for one in held:
        peer = peers.get(_inode(one)) if one.target.startswith("socket:") else None
        if peer is not None and peer not in own:
            other = _holder_outside(f"socket:[{peer}]", inside) or "a process outside"
            return f"{_named(one)} is a Unix socket that is connected to {other}"
    return ""


def tracer(pid: int) -> int:
    """Return the pid of the process that traces this one by ptrace, e.g. a debugger; 0: none."""
    try:
        lines = Path(f"/proc/{pid}/status").read_text(errors="replace").splitlines()
    except OSError as error:
        raise_shortage(error)
        return 0
    return next((int(line.split()[1]) for line in lines if line.startswith("TracerPid:")), 0)


def shared_memory(pids: Iterable[int]) -> str:
    """Describe the Fast DDS shared memory of a process tree; return "" if there is none.

    The peers of a process that is stopped or has ended remove its shared memory.
    """
    for pid in pids:
        try:
            maps = Path(f"/proc/{pid}/maps").read_text(errors="replace")
        except OSError as error:  # the process has ended
            raise_shortage(error)
            continue
        found = next((line for line in maps.splitlines() if _OF_FAST_DDS in line), "")
        if found:
            path = found.split(None, 5)[5]
            return (
                f"its ROS participant has shared memory ({path}), which its peers remove while it "
                f"is frozen: set `FASTDDS_BUILTIN_TRANSPORTS: UDPv4` in its `environment`, "
                f"or `transports: UDPv4` below `ros:` in the file of its host, and restart it"
            )
    return ""


def _half_pipes(held: Iterable[Descriptor]) -> Iterator[Descriptor]:
    """Yield one end of each pipe whose other end is not in `held`."""
    ends: dict[str, list[Descriptor]] = {}
    for one in held:
        if one.target.startswith("pipe:"):
            ends.setdefault(one.target, []).append(one)
    for found in ends.values():
        if len({one.writes for one in found}) == 1:
            yield found[0]


def _holder_outside(target: str, inside: list[int]) -> str:
    others = [stat.pid for stat in everyone() if stat.pid not in inside]
    for one in descriptors(others):
        if one.target == target:
            return f"pid {one.pid} ({program(one.pid)})"
    return ""


def program(pid: int) -> str:
    """Return the command name of a process, or "ended"."""
    try:
        return Path(f"/proc/{pid}/comm").read_text(errors="replace").strip()
    except OSError:
        return "ended"


def _named(one: Descriptor) -> str:
    return f"file descriptor {one.number} of pid {one.pid} ({program(one.pid)})"


def _inode(one: Descriptor) -> int:
    return int(one.target.partition("[")[2].rstrip("]"))


def _unix_peers() -> Mapping[int, int]:
    """Return the peer's inode for each connected Unix socket of this network namespace."""
    request = struct.pack("=BBHIIIII", socket.AF_UNIX, 0, 0, 0xFFFFFFFF, 0, _SHOW_PEER, 0, 0)
    header = struct.pack("=IHHII", 16 + len(request), _SOCK_DIAG_BY_FAMILY, _REQUEST_ALL, 0, 0)
    peers: dict[int, int] = {}
    try:
        with socket.socket(socket.AF_NETLINK, socket.SOCK_RAW, _NETLINK_SOCK_DIAG) as kernel:
            kernel.settimeout(5.0)
            kernel.sendto(header + request, (0, 0))
            while _read_peers(kernel.recv(1 << 17), peers):
                pass
    except OSError as error:  # a kernel without sock_diag, on which CRIU cannot dump any socket
        raise_shortage(error)
        return {}
    return peers


def _read_peers(answer: bytes, peers: dict[int, int]) -> bool:
    """Add the peers of one kernel datagram; return False if it was the last one."""
    offset = 0
    while offset + 16 <= len(answer):
        length, kind = struct.unpack_from("=IH", answer, offset)
        if kind in (_DONE, _ERROR):
            return False
        inode = struct.unpack_from("=I", answer, offset + 20)[0]
        position = offset + 32
        while position + 4 <= offset + length:
            size, name = struct.unpack_from("=HH", answer, position)
            if name == _PEER:
                peers[inode] = struct.unpack_from("=I", answer, position + 4)[0]
            position += max(4, (size + 3) & ~3)
        offset += (length + 3) & ~3
    return True


def odd_descriptors(pids: Iterable[int]) -> Iterator[tuple[Descriptor, str]]:
    """Yield the descriptors that most likely made CRIU fail, each with its kind."""
    for one in descriptors(pids):
        if one.target.startswith("anon_inode:[io_uring]"):
            yield one, "an io_uring"
        elif one.target.startswith("/dev/") and _is_device(one):
            yield one, f"the device {one.target}"


def _is_device(one: Descriptor) -> bool:
    """Return True for a device, except memory and random ones (`/dev/null`), equal on all hosts."""
    try:
        status = os.stat(f"/proc/{one.pid}/fd/{one.number}")  # noqa: PTH116 - a link into nothing
    except OSError:
        return False
    return status.st_rdev != 0 and os.major(status.st_rdev) != 1
