"""Probe `cpu`: cores in use, as a mean over the last second."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from rosrm import PositiveSeconds, ProbeContext, Sessions
from rosrm.shortage import exists, is_directory
from rosrm_resources.cgroups import (
    Group,
    count_cpus,
    find_group,
    raise_unless_gone,
    read_number,
)
from rosrm_resources.files import OpenFile, ProcessFiles
from rosrm_resources.gauge import Gauge, GaugeProbe, Scope, budget, check_group
from rosrm_resources.paced import Paced
from rosrm_resources.rate import Rate, check_window

_TICKS: Final = float(os.sysconf("SC_CLK_TCK"))
#: Seconds by which `Sessions.pids` may lag; the CPU time of a new pid may cover as much time.
_BEHIND: Final = 1.1
#: Index of the start time among the fields of /proc/PID/stat that follow the process name.
_START: Final = 19


@dataclass(frozen=True)
class CpuOptions:
    """Settings of the probe `cpu`.

    Attributes:
        scope: what is measured; None: the scope of the host's configuration.
        window: seconds over which the usage is a mean.
        group: the control group to measure instead of the slave's own, as /proc/PID/cgroup writes
            it for a process in it; None: the slave's own. Sets the scope to "cgroup".
    """

    scope: Scope | None = None
    window: PositiveSeconds = 1.0
    group: str | None = None

    def __post_init__(self) -> None:
        """Check the options.

        Raises:
            ValueError: the window is too long, or a group has a scope other than "cgroup".
        """
        check_window(self.window)
        check_group(self.group, self.scope)


def create(options: CpuOptions, context: ProbeContext) -> GaugeProbe:
    """Create the probe for the configured scope."""
    scope = "cgroup" if options.group else options.scope or context.scope
    gauge: Gauge | None = None
    if scope == "slice":
        gauge = SliceCpu(budget(context, "cpu", "cores"), context.sessions, options.window)
    elif scope == "cgroup":
        gauge = CgroupCpu.find(options.window, path=options.group)
    return GaugeProbe("cpu", "core", gauge or MachineCpu(options.window), "attributed")


def machine_cores(proc: Path = Path("/proc")) -> float:
    """Return the number of online cores, including those that this process may not use."""
    lines = (proc / "stat").read_text().splitlines()
    return float(max(1, sum(line.startswith("cpu") for line in lines) - 1))


class MachineCpu:
    """CPU usage of all cores of the machine.

    Time stolen by a hypervisor counts as used, because it is not available. The values come from
    /proc/stat, as in `psutil.cpu_times`; ten reads a second of the file itself cost a third.

    Args:
        window: seconds.
        proc: mount point of the process file system.
    """

    scope: Final = "machine"

    def __init__(self, window: float, proc: Path = Path("/proc")) -> None:
        self.capacity: Final = machine_cores(proc)
        self._file = OpenFile(proc / "stat", 256)
        busy, total = self._times()
        # A busy machine must not look idle in its first reading, because the master may place work
        # by it.
        guess = min(os.getloadavg()[0], self.capacity)
        self._rate = Rate(window, total, busy, guess)

    def usage(self) -> float:
        """Return the fraction of all cores in use."""
        busy, total = self._times()
        # Per second of total time: the total over all cores, divided by their number.
        return self._rate.update(total, busy) / self.capacity

    def close(self) -> None:
        """Close /proc/stat."""
        self._file.close()

    def _times(self) -> tuple[float, float]:
        """Return the busy seconds summed over all cores, and the elapsed seconds."""
        line = self._file.read().split(b"\n", 1)[0]
        # user nice system idle iowait irq softirq steal; guest time is part of user.
        times = [*map(int, line.split()[1:9])]
        idle = times[3] + times[4]
        total = sum(times)
        return (total - idle) / _TICKS, total / _TICKS / self.capacity


class CgroupCpu:
    """CPU usage against the cores that the control group may use, by quota or by CPU set.

    Where several nested groups have a limit, the one with the least room counts.

    Args:
        limits: (directory of a group, cores that it may use); the smallest gives the capacity.
        read_time: opens the counter of CPU seconds of the group in a directory.
        window: seconds.
        clock: monotonic seconds.
    """

    scope: Final = "cgroup"

    def __init__(
        self,
        limits: list[tuple[Path, float]],
        read_time: Callable[[Path], GroupTime],
        window: float,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.capacity: Final = min(cores for _, cores in limits)
        self._clock = clock
        now = clock()
        self._levels: list[tuple[float, GroupTime, Rate]] = []
        for directory, cores in limits:
            used = read_time(directory)
            self._levels.append((cores, used, Rate(window, now, used.seconds())))

    @classmethod
    def find(
        cls,
        window: float,
        root: Path = Path("/"),
        clock: Callable[[], float] = time.monotonic,
        path: str | None = None,
    ) -> CgroupCpu | None:
        """Return the gauge for the group of this process; None: it may use the whole machine.

        Args:
            window: seconds.
            root: of the file system; another one for recorded trees.
            clock: monotonic seconds.
            path: of another group.
        """
        group = find_group("cpu", root, path=path)
        if group is None:
            return None
        limits = _cpu_limits(group, root)
        if not limits:
            return None
        return cls(limits, lambda directory: GroupTime(group, directory, root), window, clock)

    def usage(self) -> float:
        """Return the fraction of the capacity that is no longer available."""
        now = self._clock()
        room = min(cores - rate.update(now, used.seconds()) for cores, used, rate in self._levels)
        return max(0.0, 1.0 - room / self.capacity)

    def close(self) -> None:
        """Close the control files."""
        for _, used, _ in self._levels:
            used.close()


class GroupTime:
    """CPU time of a control group and its descendants.

    Args:
        group: of the controller "cpu".
        directory: of that group or of an ancestor.
        root: of the file system; another one for recorded trees.
    """

    def __init__(self, group: Group, directory: Path, root: Path) -> None:
        self._version = group.version
        if group.version == 2:
            self._file = OpenFile(directory / "cpu.stat", 512)
            return
        # In version 1 another controller counts the time, and it may be mounted elsewhere.
        account = find_group("cpuacct", root)
        if account is not None and not exists(directory / "cpuacct.usage"):
            same = account.mount / directory.relative_to(group.mount)
            directory = same if exists(same) else account.directory
        self._file = OpenFile(directory / "cpuacct.usage", 64)

    def seconds(self) -> float:
        """Return the CPU seconds so far."""
        content = self._file.read()
        if self._version == 1:
            return int(content) * 1e-9
        after = content.split(b"usage_usec ", 1)[1]
        return int(after.split(b"\n", 1)[0]) * 1e-6

    def close(self) -> None:
        """Close the control file."""
        self._file.close()


def _cpu_limits(group: Group, root: Path) -> list[tuple[Path, float]]:
    """Return the groups with fewer cores than the machine, and their number of cores."""
    machine = machine_cores(root / "proc")
    limits = []
    for directory in group.upward():
        cores = _quota(group.version, directory)
        if cores is not None and cores < machine:
            limits.append((directory, cores))
    found = _cpu_set(group, root)
    if found is not None and found[1] < machine:
        limits.append(found)
    return limits


def _quota(version: int, directory: Path) -> float | None:
    """Return the cores that a group may use by its quota; None: no quota."""
    if version == 1:
        quota = read_number(directory / "cpu.cfs_quota_us")
        period = read_number(directory / "cpu.cfs_period_us")
    else:
        quota = read_number(directory / "cpu.max")
        period = 1.0 if quota is None else float((directory / "cpu.max").read_text().split()[1])
    return quota / period if quota is not None and period else None


def _cpu_set(group: Group, root: Path) -> tuple[Path, float] | None:
    """Return the topmost group with the effective CPU set of this process, and the set's size.

    Only that group measures all processes that share these CPUs. The process itself may be in a
    group below, such as that of the agents. None: no CPU set.

    Args:
        group: of the controller "cpu".
        root: of the file system.
    """
    sets = find_group("cpuset", root)
    if sets is None:
        return None
    name = "cpuset.effective_cpus" if sets.version == 1 else "cpuset.cpus.effective"
    own, top = 0, sets.directory
    for directory in sets.upward():
        try:
            size = count_cpus((directory / name).read_text())
        except OSError as error:  # the controller is not enabled here, so the group above counts
            raise_unless_gone(error)
            continue
        if own and size != own:  # the set above contains this one, so another size is another set
            break
        own, top = size, directory
    if not own:
        return None
    same = group.mount / top.relative_to(sets.mount)
    return (same if is_directory(same) else group.directory), float(own)


class SliceCpu:
    """CPU usage of the slave's own process tree, against a budget.

    Args:
        cores: the budget.
        sessions: the process tree.
        window: seconds.
        proc: mount point of the process file system.
        clock: monotonic seconds.
    """

    scope: Final = "slice"

    def __init__(
        self,
        cores: float,
        sessions: Sessions,
        window: float,
        proc: Path = Path("/proc"),
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.capacity: Final = cores
        self._time = TreeTime(sessions, proc, clock())
        self._rate = Rate(window, clock(), self._time.seconds(clock()))
        self._cores = Paced(lambda now: self._rate.update(now, self._time.seconds(now)), clock)

    def usage(self) -> float:
        """Return the fraction of the budget in use."""
        return self._cores.value() / self.capacity

    def close(self) -> None:
        """Close the process files."""
        self._time.close()


class TreeTime:
    """Non-decreasing counter of the CPU time of a changing set of processes.

    The time of an ended child is part of its parent's, which waited for it. A leader that has ended
    keeps its last known time until `Sessions` counts it as ended. Time used before a process was
    first seen counts only if the process started after this one, because processes of an earlier
    slave used theirs in the past.
    """

    def __init__(self, sessions: Sessions, proc: Path, now: float) -> None:
        self._sessions = sessions
        self._files = ProcessFiles(proc, "stat")
        self._leader_time: dict[int, float] = {}
        self._machine = machine_cores(proc)
        self._start = int(_stat_fields((proc / "self" / "stat").read_bytes())[_START])
        self._known: set[int] = set()
        self._taken_over = 0.0
        self._at = now
        self._before = self._sum()
        self._seconds = 0.0

    def seconds(self, now: float) -> float:
        """CPU seconds since this counter was made.

        Args:
            now: monotonic seconds.
        """
        total = self._sum()
        grown = total - self._before - self._taken_over
        # Time is lost when an orphan ends, and appears at once when a walk finds a member late.
        most = self._machine * (now - self._at + _BEHIND)
        self._seconds += min(max(0.0, grown), most)
        self._before, self._at = total, now
        return self._seconds

    def close(self) -> None:
        """Close the process files."""
        self._files.close()

    def _sum(self) -> float:
        ended = -1.0
        pids = self._sessions.pids()
        # Repeat, because a session that ends between the two calls counts twice or not at all.
        while ended != self._sessions.ended_cpu_time():
            ended = self._sessions.ended_cpu_time()
            pids = self._sessions.pids()
        total = ended
        leaders: dict[int, float] = {}
        seen: set[int] = set()
        self._taken_over = 0.0
        for pid, line in self._files.read(pids):
            fields = _stat_fields(line)
            used = (int(fields[11]) + int(fields[12]) + int(fields[13]) + int(fields[14])) / _TICKS
            total += used
            seen.add(pid)
            if pid not in self._known and int(fields[_START]) < self._start:
                self._taken_over += used
            if int(fields[3]) == pid:
                leaders[pid] = used
        for pid, used in self._leader_time.items():
            if pid not in leaders and pid in pids:
                total += used
                leaders[pid] = used
        self._leader_time, self._known = leaders, seen
        return total


def _stat_fields(line: bytes) -> list[bytes]:
    """Return the fields of /proc/PID/stat after the name, which may hold spaces and parentheses."""
    return line[line.rindex(b")") + 2 :].split(None, _START + 1)
