"""Probe `disk`: bytes in use on the file system that holds the slave's files."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Final

from annotated_types import Gt

from rosrm import ProbeContext
from rosrm_resources.gauge import Gauge, GaugeProbe, Scope, budget

#: Largest fraction of the time that walks through the directory may take.
_WALK_SHARE: Final = 0.01
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
    walk_period: Annotated[float, Gt(0)] = 5.0


def create(options: DiskOptions, context: ProbeContext) -> GaugeProbe:
    """Create the probe for the configured scope."""
    path = Path(options.path) if options.path is not None else context.data_directory
    gauge: Gauge
    if (options.scope or context.scope) == "slice" and "disk" in context.budget:
        gauge = DirectoryTree(path, budget(context, "disk", "bytes"), options.walk_period)
    else:
        gauge = FileSystem(path)
    return GaugeProbe("disk", "B", gauge)


class FileSystem:
    """Usage of the file system of a path; space reserved for root is neither used nor free.

    The figures are those of `psutil.disk_usage`.

    Args:
        path: need not exist yet; then its nearest existing ancestor determines the file system.
    """

    scope: Final = "machine"

    def __init__(self, path: Path) -> None:
        path = path.absolute()
        while not path.exists():
            path = path.parent
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

    def usage(self) -> float:
        """Return the fraction of the budget in use at the last walk."""
        started = self._clock()
        if started >= self._due:
            self._usage = tree_bytes(self._path) / self.capacity
            took = self._clock() - started
            self._due = started + max(self._period, took / _WALK_SHARE)
        return self._usage

    def close(self) -> None:
        """Do nothing, because no file is open."""


def tree_bytes(path: str) -> int:
    """Return the bytes on disk of all files below a directory, without following links."""
    total = 0
    waiting = [path]
    while waiting:
        try:
            entries = os.scandir(waiting.pop())
        except OSError:  # deleted since, or not readable for this user
            continue
        with entries:
            for entry in entries:
                try:
                    total += entry.stat(follow_symlinks=False).st_blocks * _BLOCK
                    if entry.is_dir(follow_symlinks=False):
                        waiting.append(entry.path)
                except FileNotFoundError:  # deleted since, e.g. a rotated log
                    continue
    return total
