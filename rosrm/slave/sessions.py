"""The sessions (process trees) that the slave runs, and what they use.

Told of each session's leader, it finds the other members by their session id in one walk a second:
`getsid` for each process of the host, which costs a microsecond each and reads no file. A member
that begins a session of its own (a daemon) leaves the tree, as it does for job control. Where a
launcher's program leads the session, the launcher knows the members: they may have another session.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from rosrm.slave.launch.launchers import Launchers
from rosrm.supervisor.procfs import inner_pid

_TICKS: Final = float(os.sysconf("SC_CLK_TCK"))
_PAGE: Final = os.sysconf("SC_PAGE_SIZE")


@dataclass(frozen=True, slots=True)
class SessionUsage:
    """What one session uses.

    Attributes:
        cpu: cores, mean since the walk before.
        memory: bytes, resident, sum over the members (shared pages count in each).
    """

    cpu: float
    memory: int


class SessionTable:
    """Implements `Sessions` of the contracts; the loop calls all but `pids` and `ended_cpu_time`.

    Those two may be called from any thread at any time: they return what was assigned in one step.

    Args:
        proc: where the process file system is mounted.
        session_of: session id of a process; raises `OSError` where it has ended.
        launchers: of this host.
    """

    def __init__(
        self,
        proc: Path = Path("/proc"),
        session_of: Callable[[int], int] = os.getsid,
        launchers: Launchers | None = None,
    ) -> None:
        self._proc = str(proc)
        self._session_of = session_of
        self._launchers = launchers or Launchers()
        self._members: dict[int, tuple[int, ...]] = {}
        self._led: set[int] = set()  # leaders that are, or may become, a launcher's program
        self._pids: tuple[int, ...] = ()
        self._ended_cpu_time = 0.0
        self._usage: dict[int, SessionUsage] = {}
        self._cpu_time: dict[int, float] = {}
        self._walked: float | None = None

    def pids(self) -> tuple[int, ...]:
        """Every known process of the sessions, leaders first; up to one walk behind."""
        return self._pids

    def ended_cpu_time(self) -> float:
        """Seconds of CPU that ended sessions used; never falls."""
        return self._ended_cpu_time

    def members(self, leader: int) -> tuple[int, ...]:
        """The known processes of one session, its leader first; () where it is not known."""
        return self._members.get(leader, ())

    def known_as(self, leader: int) -> tuple[int, ...]:
        """As `members`; below a launcher's program also by the pids that they see themselves.

        These are what Fast DDS writes into the names of endpoints.
        """
        members = self.members(leader)
        if leader not in self._led or not self._launchers.leads(leader):
            return members
        own = []
        for pid in members:
            with contextlib.suppress(OSError):  # it has ended meanwhile
                own.append(inner_pid(pid))
        return (*members, *own)

    def add(self, leader: int) -> None:
        """A session has begun; its leader counts at once.

        Args:
            leader: pid, which is also the session id.
        """
        self._members[leader] = (leader,)
        if self._launchers.leads(leader) is not False:
            self._led.add(leader)
        self._collect_pids()

    def remove(self, leader: int, cpu_time: float) -> None:
        """A session has ended (its leader was reaped).

        Args:
            leader: pid; of one that ended before it was added, the time counts all the same.
            cpu_time: seconds that it and its reaped children used, as `wait4` reports them.
        """
        self._members.pop(leader, None)
        self._led.discard(leader)
        self._usage.pop(leader, None)
        self._cpu_time.pop(leader, None)
        self._collect_pids()
        self._ended_cpu_time += max(0.0, cpu_time)

    def usage(self) -> Mapping[int, SessionUsage]:
        """By leader, as of the newest `refresh`; a session not yet walked is left out."""
        return self._usage

    def refresh(self, now: float) -> None:
        """Find the members and read what they use; call it once a second.

        Args:
            now: monotonic seconds.
        """
        elapsed = 0.0 if self._walked is None else now - self._walked
        self._walked = now
        if not self._members:
            return
        self._find_members()
        usage: dict[int, SessionUsage] = {}
        for leader, members in self._members.items():
            cpu_time, memory = self._read(members)
            before = self._cpu_time.get(leader)
            self._cpu_time[leader] = cpu_time
            cores = 0.0
            if before is not None and elapsed > 0:
                cores = max(0.0, cpu_time - before) / elapsed
            usage[leader] = SessionUsage(cores, memory)
        self._usage = usage

    def _find_members(self) -> None:
        found: dict[int, list[int]] = {leader: [leader] for leader in self._members}
        for entry in os.listdir(self._proc):  # noqa: PTH208 - a Path for each process costs 2 us
            if not entry.isdigit():
                continue
            pid = int(entry)
            try:
                leader = self._session_of(pid)
            except OSError:  # it has ended meanwhile
                continue
            if leader != pid and leader in found:
                found[leader].append(pid)
        for leader in tuple(self._led):
            leads = self._launchers.leads(leader)
            if leads:
                found[leader] = list(self._launchers.members(leader))
            elif leads is False:
                self._led.discard(leader)
        self._members = {leader: tuple(pids) for leader, pids in found.items()}
        self._collect_pids()

    def _collect_pids(self) -> None:
        self._pids = tuple(pid for pids in self._members.values() for pid in pids)

    def _read(self, members: tuple[int, ...]) -> tuple[float, int]:
        """CPU time in seconds (with that of reaped children) and resident bytes of some pids."""
        ticks = pages = 0
        for pid in members:
            try:
                descriptor = os.open(f"{self._proc}/{pid}/stat", os.O_RDONLY)
            except OSError:  # it has ended meanwhile
                continue
            try:
                line = os.read(descriptor, 1024)
            except OSError:
                continue
            finally:
                os.close(descriptor)
            # The name, in parentheses, may itself hold spaces and parentheses.
            fields = line[line.rindex(b")") + 2 :].split()
            ticks += int(fields[11]) + int(fields[12]) + int(fields[13]) + int(fields[14])
            pages += int(fields[21])
        return ticks / _TICKS, pages * _PAGE
