"""The probe `memory`: bytes that cannot be had by another process."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from rosrm import ProbeContext, Sessions
from rosrm_resources.cgroups import Group, find_group, read_number
from rosrm_resources.files import KeptFile, ProcessFiles
from rosrm_resources.gauge import Gauge, GaugeProbe, Scope, budget, check_group

_PAGE: Final = os.sysconf("SC_PAGE_SIZE")


@dataclass(frozen=True)
class MemoryOptions:
    """Settings of the probe `memory`.

    Attributes:
        scope: what is measured; None: as the host's configuration says.
        group: the control group to measure instead of the slave's own, as /proc/PID/cgroup writes
            it for a process in it; None: the slave's own. Sets the scope to "cgroup".
    """

    scope: Scope | None = None
    group: str | None = None

    def __post_init__(self) -> None:
        """A group and another scope contradict each other."""
        check_group(self.group, self.scope)


def create(options: MemoryOptions, context: ProbeContext) -> GaugeProbe:
    """Make the probe for the scope that is set."""
    scope = "cgroup" if options.group else options.scope or context.scope
    gauge: Gauge | None = None
    if scope == "slice":
        gauge = SliceMemory(budget(context, "memory", "bytes"), context.sessions)
    elif scope == "cgroup":
        gauge = CgroupMemory.find(path=options.group)
    return GaugeProbe("memory", "B", gauge or MachineMemory())


class MachineMemory:
    """What the kernel cannot give without swapping: cache that can be dropped is not usage.

    Read from /proc/meminfo itself, the same way as `psutil.virtual_memory` does: ten times a
    second that costs a third.

    Args:
        proc: where the process file system is mounted.
    """

    scope: Final = "machine"

    def __init__(self, proc: Path = Path("/proc")) -> None:
        self._file = KeptFile(proc / "meminfo", 256)
        self.capacity: Final = self._bytes(b"MemTotal:")

    def usage(self) -> float:
        """Fraction of the machine's memory."""
        return 1.0 - self._bytes(b"MemAvailable:") / self.capacity

    def close(self) -> None:
        """Close /proc/meminfo."""
        self._file.close()

    def _bytes(self, key: bytes) -> float:
        after = self._file.read().split(key, 1)[1]
        return int(after.split(None, 1)[0]) * 1024.0


class CgroupMemory:
    """The memory that the control group may use.

    Where several groups above each other have a limit, the one with the least room counts.

    Args:
        limits: (directory of a group, bytes that it may use), the smallest gives the capacity.
        version: of the control groups, 1 or 2.
    """

    scope: Final = "cgroup"

    def __init__(self, limits: list[tuple[Path, float]], version: int) -> None:
        self.capacity: Final = min(limit for _, limit in limits)
        self._levels = [(limit, _GroupBytes(directory, version)) for directory, limit in limits]

    @classmethod
    def find(cls, root: Path = Path("/"), path: str | None = None) -> CgroupMemory | None:
        """For the group of this process; None: it may use the whole machine.

        Args:
            root: of the file system, for recorded trees.
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
        """Fraction of the capacity that is not to be had any more."""
        room = min(limit - used.read() for limit, used in self._levels)
        return max(0.0, 1.0 - room / self.capacity)

    def close(self) -> None:
        """Close the control files."""
        for _, used in self._levels:
            used.close()


class _GroupBytes:
    """The bytes of a control group that are in use: inactive page cache can be dropped at once."""

    def __init__(self, directory: Path, version: int) -> None:
        current = "memory.usage_in_bytes" if version == 1 else "memory.current"
        # In version 1 only the totals count in the groups below, as the usage does.
        self._key = b"\ntotal_inactive_file " if version == 1 else b"\ninactive_file "
        self._current = KeptFile(directory / current, 64)
        self._stat = KeptFile(directory / "memory.stat")

    def read(self) -> float:
        current = int(self._current.read())
        _, key, after = self._stat.read().partition(self._key)
        inactive = int(after.split(None, 1)[0]) if key else 0
        # The two files are not of one instant.
        return float(max(0, current - inactive))

    def close(self) -> None:
        self._current.close()
        self._stat.close()


def _memory_limits(group: Group, machine: float) -> list[tuple[Path, float]]:
    """The groups whose memory is bounded below that of the machine, and to how many bytes."""
    # Above memory.high a group is not killed but slowed to a crawl: no room either.
    names = ("memory.limit_in_bytes",) if group.version == 1 else ("memory.max", "memory.high")
    limits = []
    for directory in group.upward():
        found = [read_number(directory / name) for name in names]
        bounds = [bound for bound in found if bound is not None and 0 < bound < machine]
        if bounds:
            limits.append((directory, min(bounds)))
    return limits


class SliceMemory:
    """The resident memory of the slave's own process tree, against a budget.

    Pages that processes share count in each of them: more than what they take, never less. What
    each has to itself would cost the kernel a walk over all its pages.

    Args:
        size: bytes, the budget.
        sessions: the process tree.
        proc: where the process file system is mounted.
    """

    scope: Final = "slice"

    def __init__(self, size: float, sessions: Sessions, proc: Path = Path("/proc")) -> None:
        self.capacity: Final = size
        self._sessions = sessions
        self._files = ProcessFiles(proc, "statm")

    def usage(self) -> float:
        """Fraction of the budget in use."""
        pages = 0
        for _, line in self._files.read(self._sessions.pids()):
            pages += int(line.split(None, 2)[1])
        return pages * _PAGE / self.capacity

    def close(self) -> None:
        """Close the process files."""
        self._files.close()
