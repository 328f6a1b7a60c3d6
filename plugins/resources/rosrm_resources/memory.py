"""Probe `memory`: bytes that are not available to another process.

The memory of processes, of control groups and of slices is the same quantity, so that each can be
compared with the others: anonymous and shared memory. Pages of files do not count, because the
kernel can drop them. On a whole machine the kernel's own memory counts too.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from rosrm import ProbeContext, Sessions
from rosrm.shortage import exists
from rosrm_resources.cgroups import Group, find_group, read_number
from rosrm_resources.files import OpenFile, ProcessFiles
from rosrm_resources.gauge import Gauge, GaugeProbe, Scope, budget, check_group
from rosrm_resources.paced import Paced

#: Lines of /proc/PID/status with the memory of a process, in KiB.
_USED: Final = re.compile(rb"^Rss(?:Anon|Shmem):\s*(\d+)", re.MULTILINE)
#: Keys of memory.stat with the same memory. Only the totals of version 1 include the groups below.
_KEYS: Final = {1: (b"total_rss", b"total_shmem"), 2: (b"anon", b"shmem")}
#: Keys of the page cache, for a kernel that does not count shared memory.
_CACHE: Final = {
    1: (b"total_inactive_file", b"total_active_file"), 2: (b"inactive_file", b"active_file"),
}  # fmt: skip


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

    The values come from /proc/meminfo, as in `psutil.virtual_memory`. Ten reads a second of the
    open file cost a third of those by psutil. The cache of ZFS (ARC) shrinks as the page cache
    does, but MemAvailable leaves it out.

    Args:
        proc: mount point of the process file system.
    """

    scope: Final = "machine"

    def __init__(self, proc: Path = Path("/proc")) -> None:
        self._file = OpenFile(proc / "meminfo", 256)
        arc = proc / "spl/kstat/zfs/arcstats"
        self._arc = OpenFile(arc, 1 << 14) if exists(arc) else None
        self.capacity: Final = self._bytes(b"MemTotal:")

    def usage(self) -> float:
        """Return the fraction of the machine's memory in use."""
        return max(0.0, 1.0 - self.available() / self.capacity)

    def available(self) -> float:
        """Return the bytes that new processes can use."""
        return self._bytes(b"MemAvailable:") + self._reclaimable_arc()

    def close(self) -> None:
        """Close the files."""
        self._file.close()
        if self._arc is not None:
            self._arc.close()

    def _reclaimable_arc(self) -> float:
        if self._arc is None:
            return 0.0
        rows = (line.split() for line in self._arc.read().splitlines())
        values = {row[0]: int(row[2]) for row in rows if len(row) == 3 and row[2].isdigit()}
        return float(max(0, values.get(b"size", 0) - values.get(b"c_min", 0)))

    def _bytes(self, key: bytes) -> float:
        after = self._file.read().split(key, 1)[1]
        return int(after.split(None, 1)[0]) * 1024.0


class CgroupMemory:
    """Memory usage against the limit of the control group.

    Where several nested groups have a limit, the one with the least room counts. A machine with
    less room than the groups leaves no more than it has.

    Args:
        limits: (directory of a group, bytes that it may use); the smallest gives the capacity.
        version: of the control groups, 1 or 2.
        machine: memory of the machine; None: unknown.
    """

    scope: Final = "cgroup"

    def __init__(
        self, limits: list[tuple[Path, float]], version: int, machine: MachineMemory | None = None
    ) -> None:
        self._machine = machine
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
        limits = _memory_limits(group, machine.capacity)
        if limits:
            return cls(limits, group.version, machine)
        machine.close()
        return None

    def usage(self) -> float:
        """Return the fraction of the capacity that is no longer available."""
        room = min(limit - used.read() for limit, used in self._levels)
        if self._machine is not None:
            room = min(room, self._machine.available())
        return max(0.0, 1.0 - room / self.capacity)

    def close(self) -> None:
        """Close the control files."""
        for _, used in self._levels:
            used.close()
        if self._machine is not None:
            self._machine.close()


class _GroupBytes:
    """Anonymous and shared memory of a control group in bytes."""

    def __init__(self, directory: Path, version: int) -> None:
        current = "memory.usage_in_bytes" if version == 1 else "memory.current"
        self._keys, self._cache = _KEYS[version], _CACHE[version]
        self._current = OpenFile(directory / current, 64)
        self._stat = OpenFile(directory / "memory.stat")

    def read(self) -> float:
        words = self._stat.read().split()
        numbers = dict(zip(words[::2], map(int, words[1::2]), strict=False))
        if all(key in numbers for key in self._keys):
            return float(sum(numbers[key] for key in self._keys))
        cache = sum(numbers.get(key, 0) for key in self._cache)
        # The difference can be negative, because the two files are read at different times.
        return float(max(0, int(self._current.read()) - cache))

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
    """Anonymous and shared memory of the slave's own process tree, against a budget.

    Shared memory counts in each process, so the sum is too high rather than too low.

    Args:
        size: the budget, bytes.
        sessions: the process tree.
        proc: mount point of the process file system.
    """

    scope: Final = "slice"

    def __init__(self, size: float, sessions: Sessions, proc: Path = Path("/proc")) -> None:
        self.capacity: Final = size
        self._sessions = sessions
        self._files = ProcessFiles(proc, "status", 4096)
        self._used = Paced(self._sum)

    def usage(self) -> float:
        """Return the fraction of the budget in use."""
        return self._used.value() / self.capacity

    def _sum(self, _now: float) -> float:
        used = 0
        for _, content in self._files.read(self._sessions.pids()):
            used += sum(map(int, _USED.findall(content)))
        return used * 1024.0

    def close(self) -> None:
        """Close the process files."""
        self._files.close()
