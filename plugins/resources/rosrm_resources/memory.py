"""Probe `memory`: bytes that are not available to another process."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from rosrm import ProbeContext, Sessions
from rosrm_resources.cgroups import Group, find_group, read_number
from rosrm_resources.files import OpenFile, ProcessFiles
from rosrm_resources.gauge import Gauge, GaugeProbe, Scope, budget, check_group

_PAGE: Final = os.sysconf("SC_PAGE_SIZE")


@dataclass(frozen=True)
class MemoryOptions:
    """Settings of the probe `memory`.

    Attributes:
        scope: what is measured; None: the scope of the host's configuration.
        group: the control group to measure instead of the slave's own, as /proc/PID/cgroup writes
            it for a process in it; None: the slave's own. Sets the scope to "cgroup".
    """

    scope: Scope | None = None
    group: str | None = None

    def __post_init__(self) -> None:
        """Raise `ValueError` if a group is given with a scope other than "cgroup"."""
        check_group(self.group, self.scope)


def create(options: MemoryOptions, context: ProbeContext) -> GaugeProbe:
    """Create the probe for the configured scope."""
    scope = "cgroup" if options.group else options.scope or context.scope
    gauge: Gauge | None = None
    if scope == "slice":
        gauge = SliceMemory(budget(context, "memory", "bytes"), context.sessions)
    elif scope == "cgroup":
        gauge = CgroupMemory.find(path=options.group)
    return GaugeProbe("memory", "B", gauge or MachineMemory(), "attributed")


class MachineMemory:
    """Memory that the kernel cannot give without swapping; reclaimable cache is not usage.

    The values come from /proc/meminfo, as in `psutil.virtual_memory`; ten reads a second of the
    file itself cost a third.

    Args:
        proc: mount point of the process file system.
    """

    scope: Final = "machine"

    def __init__(self, proc: Path = Path("/proc")) -> None:
        self._file = OpenFile(proc / "meminfo", 256)
        self.capacity: Final = self._bytes(b"MemTotal:")

    def usage(self) -> float:
        """Return the fraction of the machine's memory in use."""
        return 1.0 - self._bytes(b"MemAvailable:") / self.capacity

    def close(self) -> None:
        """Close /proc/meminfo."""
        self._file.close()

    def _bytes(self, key: bytes) -> float:
        after = self._file.read().split(key, 1)[1]
        return int(after.split(None, 1)[0]) * 1024.0


class CgroupMemory:
    """Memory usage against the limit of the control group.

    Where several nested groups have a limit, the one with the least room counts.

    Args:
        limits: (directory of a group, bytes that it may use); the smallest gives the capacity.
        version: of the control groups, 1 or 2.
    """

    scope: Final = "cgroup"

    def __init__(self, limits: list[tuple[Path, float]], version: int) -> None:
        self.capacity: Final = min(limit for _, limit in limits)
        self._levels = [(limit, _GroupBytes(directory, version)) for directory, limit in limits]

    @classmethod
    def find(cls, root: Path = Path("/"), path: str | None = None) -> CgroupMemory | None:
        """Return the gauge for the group of this process; None: it may use the whole machine.

        Args:
            root: of the file system; another one for recorded trees.
            path: of another group.
        """
        group = find_group("memory", root, path=path)
        if group is None:
            return None
        machine = MachineMemory(root / "proc")
        machine.close()
        limits = _memory_limits(group, machine.capacity)
        return cls(limits, group.version) if limits else None

    def usage(self) -> float:
        """Return the fraction of the capacity that is no longer available."""
        room = min(limit - used.read() for limit, used in self._levels)
        return max(0.0, 1.0 - room / self.capacity)

    def close(self) -> None:
        """Close the control files."""
        for _, used in self._levels:
            used.close()


class _GroupBytes:
    """Bytes in use of a control group, without inactive page cache, which is reclaimed at once."""

    def __init__(self, directory: Path, version: int) -> None:
        current = "memory.usage_in_bytes" if version == 1 else "memory.current"
        # In version 1 only the totals include the groups below, as the usage does.
        self._key = b"\ntotal_inactive_file " if version == 1 else b"\ninactive_file "
        self._current = OpenFile(directory / current, 64)
        self._stat = OpenFile(directory / "memory.stat")

    def read(self) -> float:
        current = int(self._current.read())
        _, key, after = self._stat.read().partition(self._key)
        inactive = int(after.split(None, 1)[0]) if key else 0
        # The difference can be negative, because the two files are read at different times.
        return float(max(0, current - inactive))

    def close(self) -> None:
        self._current.close()
        self._stat.close()


def _memory_limits(group: Group, machine: float) -> list[tuple[Path, float]]:
    """Return the groups with less memory than the machine, and their limits in bytes."""
    # Above memory.high the kernel throttles a group heavily, so that is no usable room either.
    names = ("memory.limit_in_bytes",) if group.version == 1 else ("memory.max", "memory.high")
    limits = []
    for directory in group.upward():
        found = [read_number(directory / name) for name in names]
        bounds = [bound for bound in found if bound is not None and 0 < bound < machine]
        if bounds:
            limits.append((directory, min(bounds)))
    return limits


class SliceMemory:
    """Resident memory of the slave's own process tree, against a budget.

    Shared pages count in each process, so the sum is too high rather than too low. For the private
    part of each process the kernel would walk over all its pages.

    Args:
        size: the budget, bytes.
        sessions: the process tree.
        proc: mount point of the process file system.
    """

    scope: Final = "slice"

    def __init__(self, size: float, sessions: Sessions, proc: Path = Path("/proc")) -> None:
        self.capacity: Final = size
        self._sessions = sessions
        self._files = ProcessFiles(proc, "statm")

    def usage(self) -> float:
        """Return the fraction of the budget in use."""
        pages = 0
        for _, line in self._files.read(self._sessions.pids()):
            pages += int(line.split(None, 2)[1])
        return pages * _PAGE / self.capacity

    def close(self) -> None:
        """Close the process files."""
        self._files.close()
