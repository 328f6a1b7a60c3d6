"""Probe `disk`: bytes in use on the file system that holds the slave's files."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from rosrm import PositiveSeconds, ProbeContext, Sessions
from rosrm.shortage import exists
from rosrm_resources.cgroups import lines_of, raise_unless_gone
from rosrm_resources.gauge import GaugeProbe, Scope, budget

#: Largest fraction of the time that walks through the directory may take.
_WALK_SHARE: Final = 0.01
#: Share of a file system that a process has written before it can be the one that fills the disk.
_MUCH: Final = 0.01
#: Bytes of a unit of `st_blocks`, independent of the block size of the file system.
_BLOCK: Final = 512


@dataclass(frozen=True)
class DiskOptions:
    """Settings of the probe `disk`.

    Attributes:
        scope: what is measured; None: the scope of the host's configuration. A control group has
            no disk of its own, so it counts as the machine, like a slice without a disk budget.
        path: a file or directory on the disk that counts; None: the slave's data directory.
        walk_period: seconds between two walks through the directory of a slice.
    """

    scope: Scope | None = None
    path: str | None = None
    walk_period: PositiveSeconds = 5.0


def create(options: DiskOptions, context: ProbeContext) -> GaugeProbe:
    """Create the probe for the configured scope."""
    path = Path(options.path) if options.path is not None else context.data_directory
    if (options.scope or context.scope) == "slice" and "disk" in context.budget:
        tree = DirectoryTree(path, budget(context, "disk", "bytes"), options.walk_period)
        # Only the slave writes there, so the usage of processes is not in the readings.
        return GaugeProbe("disk", "B", tree, "countable")
    system = FileSystem(path)
    return DiskProbe(system, DiskWriters(system.path, _MUCH * system.capacity, context.sessions))


class DiskProbe(GaugeProbe):
    """Probe of a file system and of the processes that fill it.

    The resource is shared, because the written bytes are no measure of the room that a process
    takes: it may overwrite or delete them. They show who fills the disk, for eviction.
    """

    def __init__(self, gauge: FileSystem, writers: DiskWriters) -> None:
        super().__init__("disk", "B", gauge, "shared")
        self._writers = writers

    def by_process(self) -> Mapping[str, Mapping[int, float]]:
        """Return the bytes that each large writer has written."""
        return {"disk": self._writers.written()}


class FileSystem:
    """Usage of the file system of a path; space reserved for root is neither used nor free.

    The figures are those of `psutil.disk_usage`.

    Args:
        path: need not exist yet; then its nearest existing ancestor determines the file system.
    """

    scope: Final = "machine"

    def __init__(self, path: Path) -> None:
        path = path.absolute()
        while not exists(path):
            path = path.parent
        self.path: Final = path
        self._path = str(path)
        used, free = self._bytes()
        self.capacity: Final = float(max(1, used + free))

    def usage(self) -> float:
        """Return the fraction of the file system in use."""
        used, free = self._bytes()
        return used / (used + free) if used + free else 1.0

    def close(self) -> None:
        """Do nothing, because no file is open."""

    def _bytes(self) -> tuple[int, int]:
        """Return the bytes in use and the bytes free for every user."""
        status = os.statvfs(self._path)
        return (
            (status.f_blocks - status.f_bfree) * status.f_frsize,
            status.f_bavail * status.f_frsize,
        )


class DiskWriters:
    """Bytes that processes have written, of those that write to a file system.

    The kernel counts the bytes of a process (`/proc/PID/io`) over all its disks, with those of its
    ended children. So a process counts only once it had a file of this file system open for
    writing, which is looked up only for processes that have written much.

    Args:
        path: a file or directory of the file system.
        least: bytes that a process must have written.
        sessions: the processes that count.
    """

    def __init__(self, path: Path, least: float, sessions: Sessions) -> None:
        self._least = least
        self._sessions = sessions
        self._device = device_of(path)
        self._writers: set[int] = set()

    def written(self) -> dict[int, float]:
        """Return the bytes written by each process that has written much, by pid."""
        pids = self._sessions.pids()
        self._writers.intersection_update(pids)
        written = {}
        for pid in pids:
            amount = written_bytes(pid)
            if amount >= self._least and self._writes_here(pid):
                written[pid] = amount
        return written

    def _writes_here(self, pid: int) -> bool:
        if pid not in self._writers and writes_to(pid, self._device):
            self._writers.add(pid)
        return pid in self._writers


def device_of(path: Path) -> str:
    """Return the device number of the mount that holds a file, as mountinfo writes it."""
    descriptor = os.open(path, os.O_PATH | os.O_CLOEXEC)
    try:
        mount = _fields(f"/proc/self/fdinfo/{descriptor}")["mnt_id"]
        return _devices("self").get(mount, "")
    finally:
        os.close(descriptor)


def written_bytes(pid: int) -> float:
    """Return the bytes that a process has written to disks; 0: it has ended, or is of another user.

    Raises:
        OSError: the counters cannot be read now.
    """
    try:
        fields = _fields(f"/proc/{pid}/io")
    except OSError as error:
        raise_unless_gone(error)
        return 0.0
    return max(0.0, float(fields["write_bytes"]) - float(fields["cancelled_write_bytes"]))


def writes_to(pid: int, device: str) -> bool:
    """Return True if a process has a file on a device open for writing.

    Raises:
        OSError: the open files cannot be read now.
    """
    try:
        devices = _devices(pid)
        for descriptor in os.listdir(f"/proc/{pid}/fdinfo"):  # noqa: PTH208 - no Path for each
            fields = _fields(f"/proc/{pid}/fdinfo/{descriptor}")
            writes = int(fields["flags"], 8) & os.O_ACCMODE != os.O_RDONLY
            if writes and devices.get(fields.get("mnt_id", "")) == device:
                return True
    except OSError as error:  # the process or the file is gone
        raise_unless_gone(error)
    return False


def _fields(path: str) -> dict[str, str]:
    """Return the fields of a file with a line `name: value` for each."""
    text = Path(path).read_text(encoding="ascii", errors="replace")
    return {
        name: value.strip()
        for name, _, value in (line.partition(":") for line in text.splitlines())
    }


def _devices(pid: int | str) -> dict[str, str]:
    """Return mount id to device number of the mounts that a process sees."""
    lines = lines_of(Path(f"/proc/{pid}/mountinfo"))
    return {fields[0]: fields[2] for fields in (line.split(" ", 3) for line in lines)}


class DirectoryTree:
    """Disk usage of a directory tree against a budget, measured by infrequent walks.

    Args:
        path: of the directory; a missing one counts as empty.
        size: the budget, bytes.
        period: seconds between two walks; longer if a walk takes long.
        clock: monotonic seconds.
    """

    scope: Final = "slice"

    def __init__(
        self,
        path: Path,
        size: float,
        period: float = 5.0,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.capacity: Final = size
        self._path = str(path)
        self._period = period
        self._clock = clock
        self._due = clock()
        self._usage = 0.0
        self._fault: OSError | None = None  # of the last walk

    def usage(self) -> float:
        """Return the fraction of the budget in use at the last walk.

        Raises:
            OSError: the last walk has failed.
        """
        started = self._clock()
        if started >= self._due:
            self._fault = None
            try:
                self._usage = tree_bytes(self._path) / self.capacity
            except OSError as error:
                self._fault = error
            took = self._clock() - started
            self._due = started + max(self._period, took / _WALK_SHARE)
        if self._fault is not None:
            raise self._fault.with_traceback(None)
        return self._usage

    def close(self) -> None:
        """Do nothing, because no file is open."""


def tree_bytes(path: str) -> int:
    """Return the bytes on disk of all files below a directory, without following links.

    Directories that are deleted since, or not readable for this user, do not count.

    Raises:
        OSError: a directory cannot be read now, so the bytes are not known.
    """
    total = 0
    waiting = [path]
    while waiting:
        try:
            entries = os.scandir(waiting.pop())
        except OSError as error:
            raise_unless_gone(error)
            continue
        with entries:
            for entry in entries:
                try:
                    total += entry.stat(follow_symlinks=False).st_blocks * _BLOCK
                    if entry.is_dir(follow_symlinks=False):
                        waiting.append(entry.path)
                except OSError as error:  # deleted since, e.g. a rotated log
                    raise_unless_gone(error)
    return total
