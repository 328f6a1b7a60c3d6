"""Control groups (versions 1 and 2) of a process, and their limits.

A limit may be set at the process's own group or at any ancestor, so all of them are read. Inside a
container the groups above its own are not visible; only the visible ones count.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from rosrm import ConfigError
from rosrm.shortage import is_directory, raise_unless_absent


@dataclass(frozen=True)
class Group:
    """Control group of a process for one controller.

    Attributes:
        version: 1 or 2.
        mount: root of the hierarchy as visible to this process.
        directory: of the group; `mount` itself or a directory below it.
    """

    version: int
    mount: Path
    directory: Path

    def upward(self) -> Iterator[Path]:
        """Yield the directories of the group and of its visible ancestors."""
        directory = self.directory
        while True:
            yield directory
            if directory == self.mount:
                return
            directory = directory.parent


@dataclass(frozen=True)
class _Mount:
    root: str
    point: Path
    version: int
    controllers: frozenset[str]


def find_group(
    controller: str, root: Path = Path("/"), pid: str = "self", path: str | None = None
) -> Group | None:
    """Return the group of a process for a controller; None: no such hierarchy is mounted.

    Args:
        controller: "memory", "cpu", "cpuacct", "cpuset".
        root: of the file system; another one for recorded trees.
        pid: of the process; "self" for this process.
        path: of another group, as /proc/PID/cgroup writes it; None: that of the process.

    Raises:
        ConfigError: there is no group at `path`.
    """
    mounts = _mounts(root, pid)
    paths = _paths(root, pid)
    if path is not None:
        paths = dict.fromkeys(paths, path)
    # A controller mounted as version 1 is not available to version 2 at the same time.
    for mount in sorted(mounts, key=lambda mount: mount.version):
        name = controller if mount.version == 1 else ""
        if (mount.version == 2 or controller in mount.controllers) and name in paths:
            directory = _below(mount, paths[name])
            if path is not None and directory.name != Path(path).name:
                raise ConfigError(
                    f"there is no control group {path!r} under {mount.point}; "
                    "write it as /proc/PID/cgroup does for a process in it"
                )
            return Group(mount.version, mount.point, directory)
    return None


def read_number(path: Path) -> float | None:
    """Return the number in a control file; None: no file, or no limit ("max" or -1).

    Raises:
        OSError: the file cannot be read now.
    """
    try:
        word = path.read_text().split()[0]
    except (OSError, IndexError) as error:
        if isinstance(error, OSError):
            raise_unless_gone(error)
        return None
    if word in ("max", "-1"):
        return None
    return float(word)


def count_cpus(text: str) -> int:
    """Return the number of CPUs in a list such as "0-3,8"."""
    count = 0
    for part in text.strip().split(","):
        first, _, last = part.partition("-")
        if first:
            count += int(last or first) - int(first) + 1
    return count


def _paths(root: Path, pid: str) -> dict[str, str]:
    """Return the path of the group by controller; that of version 2 under ""."""
    paths: dict[str, str] = {}
    for line in lines_of(root / "proc" / pid / "cgroup"):
        _, controllers, path = line.split(":", 2)
        for controller in controllers.split(","):
            paths[controller] = path
    return paths


def _mounts(root: Path, pid: str) -> list[_Mount]:
    mounts = []
    for line in lines_of(root / "proc" / pid / "mountinfo"):
        before, _, after = line.partition(" - ")
        kind, _, options = after.split(" ", 2)
        if kind not in ("cgroup", "cgroup2"):
            continue
        fields = before.split(" ")
        point = root / _unescaped(fields[4]).lstrip("/")
        controllers = frozenset(options.split(","))
        version = 1 if kind == "cgroup" else 2
        mounts.append(_Mount(_unescaped(fields[3]), point, version, controllers))
    return mounts


def lines_of(file: Path) -> list[str]:
    """Return the lines of a file of /proc, whose paths may have any bytes; []: it is not there.

    Raises:
        OSError: the file cannot be read now.
    """
    try:
        return os.fsdecode(file.read_bytes()).split("\n")[:-1]
    except OSError as error:
        raise_unless_gone(error)
        return []


def raise_unless_gone(error: OSError) -> None:
    """Raise an error again unless it means that a process or file is gone or of another user."""
    if not isinstance(error, PermissionError):
        raise_unless_absent(error)


def _unescaped(path: str) -> str:
    r"""Replace the octal escapes of mountinfo, which writes a space as \040."""
    return re.sub(r"\\([0-7]{3})", lambda match: chr(int(match.group(1), 8)), path)


def _below(mount: _Mount, path: str) -> Path:
    """Return the directory of a group below its mount, or its nearest visible ancestor."""
    if mount.root != "/":
        # In a container without a cgroup namespace only a part of the hierarchy is mounted.
        inside = path == mount.root or path.startswith(mount.root + "/")
        path = path[len(mount.root) :] if inside else "/"
    parts = [part for part in path.split("/") if part]
    if ".." in parts:  # a group above the root of our namespace is not visible
        parts = []
    while parts and not is_directory(mount.point.joinpath(*parts)):
        parts.pop()
    return mount.point.joinpath(*parts)
