"""Control groups (cgroups) of versions 1 and 2: mounts, and the group of this process.

The supervisor imports this module: it stays small.
"""

from __future__ import annotations

import contextlib
import errno
import os
import re
from typing import Final, NamedTuple

#: Group for the processes of rosrm itself. In version 2 a group with processes in it gives no
#: controllers to the groups below it, so slave and supervisor run beside the groups of instances.
AGENTS: Final = "rosrm-agent"
#: Controllers that limit memory and CPU.
LIMITING: Final = ("memory", "cpu")
#: Files that a kernel without swap, or without accounting of it, lacks.
ABOUT_SWAP: Final = ("memory.memsw.limit_in_bytes", "memory.swap.max")
#: Seconds. Shorter than the kernel's 100 ms: a process that has used up its share is paused so
#: shortly that ROS does not notice.
_PERIOD: Final = 0.02
_LONG_PERIOD: Final = 0.1
#: Cores; below this the share of a short period is less than the least possible, a millisecond.
_SHORT_ENOUGH: Final = 0.05
#: No limit, in a control file of version 2.
_NONE: Final = "max"
_ESCAPE: Final = re.compile(r"\\([0-7]{3})")


class Mount(NamedTuple):
    """A mounted hierarchy of control groups.

    Attributes:
        version: 1 or 2.
        root: group at the mount point, as /proc/PID/cgroup writes it.
        point: path of the mount point.
        controllers: of version 1, among other words; of version 2 `cgroup.controllers` has them.
    """

    version: int
    root: str
    point: str
    controllers: frozenset[str]


def mounts(root: str = "/") -> list[Mount]:
    """Return the mounted hierarchies, version 1 first; lines of another form are left out.

    Args:
        root: of the file system; another one for recorded trees.

    Raises:
        OSError: /proc cannot be read.
    """
    found = []
    for line in _lines(os.path.join(root, "proc/self/mountinfo")):
        before, _, after = line.partition(" - ")
        fields, words = before.split(" "), after.split(" ", 2)
        if words[0] in ("cgroup", "cgroup2") and len(fields) > 4:
            point = os.path.join(root, _unescaped(fields[4]).lstrip("/"))
            version = 1 if words[0] == "cgroup" else 2
            controllers = frozenset(words[-1].split(","))
            found.append(Mount(version, _unescaped(fields[3]), point, controllers))
    return sorted(found, key=lambda mount: mount.version)


def own_group(mount: Mount, root: str = "/") -> str | None:
    """Return the directory of this process's group; None: it is not visible at this mount.

    Raises:
        OSError: /proc cannot be read.
    """
    for line in _lines(os.path.join(root, "proc/self/cgroup")):
        names, _, path = line.partition(":")[2].partition(":")
        if not path.startswith("/"):
            continue
        if (mount.version == 2 and not names) or set(names.split(",")) & mount.controllers - {""}:
            inside = os.path.relpath(path, mount.root)
            directory = os.path.normpath(os.path.join(mount.point, inside))
            visible = not inside.startswith("..") and os.path.isdir(directory)
            return directory if visible else None
    return None


def memory_files(version: int, size: int) -> list[tuple[str, str]]:
    """Return the control files of a limit of memory in bytes, in order, with their content.

    The order is that of a limit that is set or lowered. Size 0: no limit.
    """
    if version == 1:
        names = "memory.limit_in_bytes", "memory.memsw.limit_in_bytes"
        return [(name, str(size or -1)) for name in names]
    return [("memory.max", str(size or _NONE)), ("memory.swap.max", "0" if size else _NONE)]


def cpu_files(version: int, cores: float) -> list[tuple[str, str]]:
    """Return the control files of a limit of CPU time, in order, with their content.

    The limit of a group above may be lower, and then holds. 0 cores: no limit.
    """
    if not cores:
        return [("cpu.cfs_quota_us", "-1") if version == 1 else ("cpu.max", _NONE)]
    seconds = _PERIOD if cores >= _SHORT_ENOUGH else _LONG_PERIOD
    quota, period = round(cores * seconds * 1e6), round(seconds * 1e6)
    if version == 1:
        return [("cpu.cfs_period_us", str(period)), ("cpu.cfs_quota_us", str(quota))]
    return [("cpu.max", f"{quota} {period}")]


def enable(group: str, controllers: tuple[str, ...]) -> None:
    """Give controllers to the groups below a group of version 2. Raises OSError."""
    switch = os.path.join(group, "cgroup.subtree_control")
    missing = set(controllers) - set(read(switch).split())
    if missing:
        write(switch, " ".join(f"+{name}" for name in sorted(missing)))


def delegate(root: str = "/") -> None:
    """Prepare this process's group of version 2 for groups below it, if that is possible.

    The process moves into a group of its own if it is the last one that hinders this. If it is not
    possible, `rosrm.supervisor.group_trees` says why.
    """
    with contextlib.suppress(OSError):
        for mount in mounts(root):
            if mount.version == 2:
                with contextlib.suppress(OSError):
                    _delegate(mount, root)


def _delegate(mount: Mount, root: str) -> None:
    own = own_group(mount, root)
    if own is not None:
        base = os.path.dirname(own) if os.path.basename(own) == AGENTS else own
        offered = read(os.path.join(base, "cgroup.controllers")).split()
        _enable_or_move(base, tuple(name for name in LIMITING if name in offered))


def _enable_or_move(base: str, controllers: tuple[str, ...]) -> None:
    try:
        enable(base, controllers)
    except OSError as error:
        if error.errno != errno.EBUSY:
            raise
        leaf = os.path.join(base, AGENTS)
        os.makedirs(leaf, exist_ok=True)
        write(os.path.join(leaf, "cgroup.procs"), "0")
        try:
            enable(base, controllers)
        except OSError:
            write(os.path.join(base, "cgroup.procs"), "0")
            os.rmdir(leaf)
            raise


def read(path: str) -> str:
    """Return the content of a control file. Raises OSError."""
    descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
    try:
        return os.read(descriptor, 1 << 16).decode()
    finally:
        os.close(descriptor)


def write(path: str, value: str) -> None:
    """Write a control file. Raises OSError."""
    descriptor = os.open(path, os.O_WRONLY | os.O_CLOEXEC)
    try:
        os.write(descriptor, value.encode())
    finally:
        os.close(descriptor)


def _lines(path: str) -> list[str]:
    """Return the lines of a file; the paths in it may have any bytes. Raises OSError."""
    with open(path, "rb") as file:
        return os.fsdecode(file.read()).split("\n")


def _unescaped(path: str) -> str:
    r"""Replace the octal escapes of mountinfo, which writes a space as \040."""
    return _ESCAPE.sub(lambda code: chr(int(code[1], 8)), path)
