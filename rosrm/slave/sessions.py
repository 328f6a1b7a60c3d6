"""Sessions (process trees) of the slave's instances, and their usage.

The slave adds the leader of each session, and the control group of its instance if there is one:
the group has all processes and the exact usage. Without a group, one walk a second finds the other
processes by their session id: `getsid` for each process of the host, which takes a microsecond and
reads no file. A process that begins a session of its own (a daemon) then leaves the tree, as in job
control. Where a launcher's program leads the session, the launcher knows the members. An adopted
process leads no session of its own, so it has its descendants as members.
"""

from __future__ import annotations

import contextlib
import os
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from rosrm.component.link import container_of
from rosrm.shortage import raise_unless_absent
from rosrm.slave.instance_group import InstanceGroup
from rosrm.slave.launch.launchers import Launchers
from rosrm.supervisor.procfs import descendants, inner_pid

_TICKS: Final = float(os.sysconf("SC_CLK_TCK"))
#: KiB of a process that the kernel cannot reclaim. Pages of files are shared and reclaimable, and a
#: host's reading counts them at most once, so they would release too much of a reservation.
_USED: Final = re.compile(rb"^Rss(?:Anon|Shmem):\s*(\d+)", re.MULTILINE)


@dataclass(frozen=True, slots=True)
class SessionUsage:
    """Usage of one session.

    Attributes:
        cpu: cores, mean since the previous walk.
        memory: anonymous bytes and bytes of shared memory; without a control group summed over the
            processes, so that shared bytes count in each.
        others: slot of another resource to the amount in its base unit, as probes measure it.
    """

    cpu: float
    memory: int
    others: Mapping[int, float] = field(default_factory=dict)


class SessionTable:
    """Implementation of the contract `Sessions`.

    `pids` and `ended_cpu_time` may be called from any thread, because they return values that are
    assigned in one step. Only the loop calls the other methods.

    Args:
        proc: mount point of the process file system.
        session_of: returns the session id of a process; raises `OSError` if it has ended.
    """

    def __init__(
        self, proc: Path = Path("/proc"), session_of: Callable[[int], int] = os.getsid,
        launchers: Launchers | None = None,
    ) -> None:  # fmt: skip
        self._proc = str(proc)
        self._session_of = session_of
        self._launchers = launchers or Launchers()
        self._members: dict[int, tuple[int, ...]] = {}
        self._groups: dict[int, InstanceGroup] = {}
        self._adopted: set[int] = set()  # leaders in a session of others
        # Leaders that are, or may become, a launcher's program, to the members that it told last.
        self._led: dict[int, tuple[int, ...]] = {}
        self._pids: tuple[int, ...] = ()
        self._ended_cpu_time = 0.0
        self._usage: dict[int, SessionUsage] = {}
        self._cpu_time: dict[int, float] = {}
        self._walked: float | None = None

    def pids(self) -> tuple[int, ...]:
        """Return every known process of the sessions, leaders first; up to one walk behind."""
        return self._pids

    def ended_cpu_time(self) -> float:
        """Return the CPU seconds of ended sessions; the value never decreases."""
        return self._ended_cpu_time

    def members(self, leader: int) -> tuple[int, ...]:
        """Return the known processes of one session, its leader first; () if it is unknown."""
        return self._members.get(leader, ())

    def known_as(self, leader: int) -> tuple[int, ...]:
        """Return `members` with further pids that Fast DDS writes into the names of endpoints.

        For members below a launcher's program, these are their pids in their own pid namespace. For
        the process of a component, this is the pid of its container.
        """
        members = self.members(leader)
        container = container_of(leader, self._proc)
        if container is not None:
            return (*members, container)
        if leader not in self._led:
            return members
        known = list(members)
        for pid in members:
            with contextlib.suppress(OSError):  # it has ended
                known.append(inner_pid(pid))
        return tuple(dict.fromkeys(known))

    def add(self, leader: int, group: InstanceGroup | None = None) -> None:
        """Add a session that has begun, by the pid of its leader, who counts at once."""
        if group is not None:
            self._groups[leader] = group
        self._members[leader] = (leader,)
        with contextlib.suppress(OSError):  # it has ended
            if self._session_of(leader) != leader:
                self._adopted.add(leader)
        self._led[leader] = ()  # until the next `refresh` asks the launchers
        self._collect_pids()

    def remove(self, leader: int, cpu_time: float) -> None:
        """Remove a session that has ended (its leader was reaped).

        The time counts even if the session was never added: the seconds used by the leader and its
        reaped children, as reported by `wait4`.
        """
        self._members.pop(leader, None)
        self._groups.pop(leader, None)
        self._adopted.discard(leader)
        self._led.pop(leader, None)
        self._usage.pop(leader, None)
        self._cpu_time.pop(leader, None)
        self._collect_pids()
        self._ended_cpu_time += max(0.0, cpu_time)

    def usage(self) -> Mapping[int, SessionUsage]:
        """Return the usage by leader, as of the last `refresh`; new sessions are left out."""
        return self._usage

    def refresh(self, now: float) -> None:
        """Find the processes of all sessions and read their usage; call this once a second.

        Without a file descriptor for it, the last usage stays.
        """
        try:
            self._find_members()
            read = {leader: self._usage_of(leader) for leader in self._members}
        except OSError:
            return
        elapsed = 0.0 if self._walked is None else now - self._walked
        self._walked = now
        usage: dict[int, SessionUsage] = {}
        for leader, (cpu_time, memory) in read.items():
            before = self._cpu_time.get(leader)
            self._cpu_time[leader] = cpu_time
            cores = 0.0
            if before is not None and elapsed > 0:
                cores = max(0.0, cpu_time - before) / elapsed
            usage[leader] = SessionUsage(cores, memory)
        self._usage = usage

    def _find_members(self) -> None:
        if not self._members:
            return
        self._groups = {leader: one for leader, one in self._groups.items() if one.exists}
        found: dict[int, list[int]] = {leader: [leader] for leader in self._members}
        for leader, group in self._groups.items():
            found[leader] += [pid for pid in group.pids() if pid != leader]
        if len(self._groups) < len(self._members):
            self._walk(found)
        for leader in self._adopted:
            found[leader] = [leader, *descendants(leader)]
        for leader, told in tuple(self._led.items()):
            members = self._launchers.members(leader)
            if members is not None and not members:
                del self._led[leader]
            elif members or told:  # a launcher that cannot tell leaves the members as they were
                found[leader] = list(members or told)
                self._led[leader] = tuple(found[leader])
        self._members = {leader: tuple(pids) for leader, pids in found.items()}
        self._collect_pids()

    def _walk(self, found: Mapping[int, list[int]]) -> None:
        """Add the processes of sessions without a control group."""
        for entry in os.listdir(self._proc):  # noqa: PTH208 - a Path for each process costs 2 us
            if not entry.isdigit():
                continue
            pid = int(entry)
            try:
                leader = self._session_of(pid)
            except OSError:  # it has ended
                continue
            if leader != pid and leader in found and leader not in self._groups:
                found[leader].append(pid)

    def _collect_pids(self) -> None:
        self._pids = tuple(pid for pids in self._members.values() for pid in pids)

    def _usage_of(self, leader: int) -> tuple[float, int]:
        """Return the CPU seconds and used bytes of a session. Raises OSError as `_read`."""
        group = self._groups.get(leader)
        cpu_time = memory = None
        if group is not None:
            cpu_time, memory = group.cpu_time(), group.memory()
        if cpu_time is None or memory is None:
            by_process = self._read(self._members[leader])
            cpu_time = by_process[0] if cpu_time is None else cpu_time
            memory = by_process[1] if memory is None else memory
        return cpu_time, memory

    def _read(self, members: tuple[int, ...]) -> tuple[float, int]:
        """Return the CPU seconds (with those of reaped children) and used bytes of pids.

        Raises:
            OSError: no file can be opened now.
        """
        ticks = used = 0
        for pid in members:
            stat = _content(f"{self._proc}/{pid}/stat", 1024)
            if not stat:
                continue
            status = _content(f"{self._proc}/{pid}/status", 4096)
            # The name, in parentheses, may itself hold spaces and parentheses.
            fields = stat[stat.rindex(b")") + 2 :].split()
            ticks += int(fields[11]) + int(fields[12]) + int(fields[13]) + int(fields[14])
            used += sum(map(int, _USED.findall(status))) * 1024
        return ticks / _TICKS, used


def _content(path: str, most: int) -> bytes:
    """Return the first bytes of a file of a process; b"": the process has ended.

    Raises:
        OSError: the file cannot be read now.
    """
    try:
        descriptor = os.open(path, os.O_RDONLY)
        try:
            return os.read(descriptor, most)
        finally:
            os.close(descriptor)
    except PermissionError:  # a process of another user
        return b""
    except OSError as error:
        raise_unless_absent(error)
        return b""
