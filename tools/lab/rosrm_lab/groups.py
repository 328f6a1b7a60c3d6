"""The control groups of a lab, version 1 or 2.

Each host has one group with three in it: `limited`, where its processes run within memory and CPU
quota; `free`, for processes on the host outside its limits; and `own` for the lab's own processes:
the first process, and the relays. Version 2 requires processes in leaves only, and a slave on the
host makes groups for its processes below `limited`; so the processes there enter a group below it.
"""

from __future__ import annotations

import contextlib
import errno
import os
import re
import signal
import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Literal

from rosrm import clocks
from rosrm.errors import LabError
from rosrm.runtime import cgroups
from rosrm.runtime.signalling import send
from rosrm.wording import reason_of
from rosrm_lab.plan import PREFIX, HostPlan

Leaf = Literal["limited", "free", "own"]
LEAVES: Final[tuple[Leaf, ...]] = ("limited", "free", "own")

#: cpuacct: version 1 keeps the CPU time of a group there.
_NEEDED: Final = ("memory", "cpu", "cpuacct")
#: Seconds for killed processes to leave their group, and for the kernel to release the group.
_GONE: Final = 10.0
_LOOK: Final = 0.01
#: Errors for a path below a deleted group, and for one of its files that was still open.
_GROUP_IS_GONE: Final = (errno.ENOENT, errno.ENODEV)
_ATTEMPTS: Final = 5


@dataclass(frozen=True, slots=True)
class Hierarchy:
    """A tree of control groups that is mounted here.

    Attributes:
        version: 1 or 2.
        mount: its top.
        controllers: those that a lab needs and it has.
    """

    version: int
    mount: Path
    controllers: tuple[str, ...]

    @property
    def top(self) -> Path:
        """Return the group of all labs."""
        return self.mount / PREFIX

    def group(self, lab: str, host: str, leaf: Leaf) -> Path:
        """Return one of a host's groups."""
        return self.top / lab / host / leaf


def find_hierarchies(root: Path = Path("/")) -> list[Hierarchy]:
    """Return the hierarchies with the controllers that a lab needs.

    Args:
        root: of the file system, for recorded trees.

    Raises:
        LabError: a controller is missing; the message names it.
    """
    found: dict[Path, Hierarchy] = {}
    missing = set(_NEEDED)
    for version, mount, offered in _mounted(root):
        ours = tuple(name for name in _NEEDED if name in offered and name in missing)
        if version == 2 and "cpu" in ours:
            missing.discard("cpuacct")  # in version 2 `cpu` keeps the time itself
        if ours:
            found[mount] = Hierarchy(version, mount, ours)
            missing -= set(ours)
    if missing:
        raise LabError(
            f"no control group (cgroup) with {' and '.join(sorted(missing))} is mounted here: "
            "without them a host has no limits. On a usual Linux they are under /sys/fs/cgroup; "
            "a container gets them with `docker run --privileged`"
        )
    return list(found.values())


def make(hierarchies: Iterable[Hierarchy], lab: str, host: HostPlan) -> None:
    """Make a host's groups and set its limits; raises `LabError`."""
    for hierarchy in hierarchies:
        try:
            for leaf in LEAVES:
                _make_group(hierarchy, _entered(hierarchy, lab, host.name, leaf))
            limited = hierarchy.group(lab, host.name, "limited")
            for name, value in limits(hierarchy, host):
                if name not in cgroups.ABOUT_SWAP or (limited / name).exists():
                    (limited / name).write_text(value)
        except OSError as error:
            raise LabError(_cannot(hierarchy, error)) from None


def limits(hierarchy: Hierarchy, host: HostPlan) -> Iterator[tuple[str, str]]:
    """Yield the control files of a host's limits, in this order, with their content."""
    if "memory" in hierarchy.controllers and host.memory is not None:
        yield from cgroups.memory_files(hierarchy.version, host.memory)
    if "cpu" in hierarchy.controllers and host.cpu is not None:
        yield from cgroups.cpu_files(hierarchy.version, host.cpu)


def doors(hierarchies: Iterable[Hierarchy], lab: str, host: str, leaf: Leaf) -> list[Path]:
    """Return the files through which a process enters one of a host's groups."""
    return [_entered(h, lab, host, leaf) / "cgroup.procs" for h in hierarchies]


def members(hierarchies: Iterable[Hierarchy], lab: str, host: str = "") -> set[int]:
    """Return the processes in the groups of a host, or of all the lab's hosts."""
    found: set[int] = set()
    for hierarchy in hierarchies:
        for door in (hierarchy.top / lab / host).rglob("cgroup.procs"):
            with contextlib.suppress(FileNotFoundError, OSError):
                found.update(int(line) for line in door.read_text().split())
    found.discard(0)  # a process outside this PID namespace
    return found


def processes(hierarchies: Iterable[Hierarchy], lab: str, host: str) -> set[int]:
    """Return the processes that were started on a host, without the lab's own ones."""
    known = list(hierarchies)
    return members(known, lab, f"{host}/limited") | members(known, lab, f"{host}/free")


def kill(hierarchies: Sequence[Hierarchy], lab: str, host: str = "") -> None:
    """End every process in the groups of a host or lab, and wait until they have gone.

    Raises:
        LabError: some did not end.
    """
    deadline = clocks.boot_time() + _GONE
    while pids := members(hierarchies, lab, host):
        for pid in pids:
            send(pid, signal.SIGKILL)
        if clocks.boot_time() > deadline:
            raise LabError(
                f"processes of lab {lab!r} do not end, {_GONE:g} s after SIGKILL: "
                f"{', '.join(map(str, sorted(pids)))}. Look at them (`ps`), then repeat this"
            )
        time.sleep(_LOOK)  # version 1 has no event for this


def remove(hierarchies: Sequence[Hierarchy], lab: str) -> None:
    """End the processes of a lab and remove its groups.

    Raises:
        LabError: a process did not end, or a group could not be removed.
    """
    deadline = clocks.boot_time() + _GONE
    while True:
        kill(hierarchies, lab)
        left = [failure for h in hierarchies if (failure := _remove_tree(h.top / lab))]
        if not left:
            break
        # The kernel releases a group a moment after its last process has gone; and a process that
        # was about to enter may have done so.
        if clocks.boot_time() > deadline:
            raise LabError(f"control groups cannot be removed: {'; '.join(left)}")
        time.sleep(_LOOK)
    for hierarchy in hierarchies:
        with contextlib.suppress(OSError):  # other labs have groups in it
            hierarchy.top.rmdir()


def labs(hierarchies: Iterable[Hierarchy]) -> set[str]:
    """Return the labs that have groups."""
    return {
        entry.name
        for hierarchy in hierarchies
        if hierarchy.top.is_dir()
        for entry in hierarchy.top.iterdir()
        if entry.is_dir()
    }


def memory_used(hierarchies: Iterable[Hierarchy], lab: str, host: str) -> int | None:
    """Return the bytes that a host's limited processes use, without cache that can be dropped."""
    for hierarchy in hierarchies:
        if "memory" not in hierarchy.controllers:
            continue
        try:
            return _memory_used(hierarchy, hierarchy.group(lab, host, "limited"))
        except OSError:
            return None
    return None


def memory_left(hierarchies: Iterable[Hierarchy]) -> int | None:
    """Return the bytes that all labs together may still use in a container with an own limit.

    None: only the machine's memory limits them. The parent of the labs' groups is the container's
    group; the groups above it are not visible here.
    """
    for hierarchy in hierarchies:
        if "memory" not in hierarchy.controllers:
            continue
        name = "memory.limit_in_bytes" if hierarchy.version == 1 else "memory.max"
        try:
            limit = (hierarchy.mount / name).read_text().strip()
            if limit != "max":
                return max(0, int(limit) - _memory_used(hierarchy, hierarchy.mount))
        except OSError:  # the machine's own group has no limit in version 2
            return None
    return None


def _entered(hierarchy: Hierarchy, lab: str, host: str, leaf: Leaf) -> Path:
    """Return the group that the processes of a leaf enter."""
    group = hierarchy.group(lab, host, leaf)
    return group / cgroups.AGENTS if (hierarchy.version, leaf) == (2, "limited") else group


# --- helpers ----------------------------------------------------------------------------------


def _memory_used(hierarchy: Hierarchy, group: Path) -> int:
    """Return the bytes that a group uses, without cache that can be dropped at once."""
    name, key = (
        ("memory.usage_in_bytes", "total_inactive_file")
        if hierarchy.version == 1
        else ("memory.current", "inactive_file")
    )
    used, details = (group / name).read_text(), (group / "memory.stat").read_text()
    cache = re.search(rf"^{key} (\d+)$", details, re.MULTILINE)
    return max(0, int(used) - (int(cache[1]) if cache else 0))


def _mounted(root: Path) -> Iterator[tuple[int, Path, frozenset[str]]]:
    """Yield version, mount point and controllers of each hierarchy; version 1 first."""
    for mount in cgroups.mounts(str(root)):
        if mount.version == 1:
            yield 1, Path(mount.point), mount.controllers
            continue
        with contextlib.suppress(OSError):
            names = Path(mount.point, "cgroup.controllers").read_text().split()
            yield 2, Path(mount.point), frozenset(names)


def _make_group(hierarchy: Hierarchy, group: Path) -> None:
    """Make a group and those above it; in version 2 each delegates the controllers to the next."""
    parts = group.relative_to(hierarchy.mount).parts
    for attempts_left in reversed(range(_ATTEMPTS)):
        above = hierarchy.mount
        try:
            for part in parts:
                if hierarchy.version == 2:
                    _delegate(above, hierarchy.controllers)
                above = above / part
                above.mkdir(exist_ok=True)
        except OSError as error:
            # The removal of another lab deletes the top group while no lab has a group in it.
            if error.errno not in _GROUP_IS_GONE or not attempts_left:
                raise
        else:
            return


def _delegate(group: Path, controllers: Sequence[str]) -> None:
    switch = group / "cgroup.subtree_control"
    missing = set(controllers) - set(switch.read_text().split())
    if missing:
        switch.write_text(" ".join(f"+{name}" for name in sorted(missing)))


def _remove_tree(tree: Path) -> str:
    """Remove groups, the deepest first; return the obstacle, or ""."""
    for folder, _, _ in os.walk(tree, topdown=False):
        try:
            Path(folder).rmdir()
        except FileNotFoundError:
            continue
        except OSError as error:
            return f"{folder}: {reason_of(error)}"
    return ""


def _cannot(hierarchy: Hierarchy, error: OSError) -> str:
    where = f"control groups cannot be made under {hierarchy.mount}: {reason_of(error)}"
    if isinstance(error, PermissionError) or "Read-only" in str(error):
        return f"{where}. A container gets the right with `docker run --privileged`"
    if hierarchy.version == 2:
        return (
            f"{where} ({error.filename}). In version 2 a group with processes in it hands nothing "
            "on: inside a container, first move its processes into a group of their own"
        )
    return f"{where} ({error.filename})"
