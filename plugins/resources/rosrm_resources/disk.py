"""The probe `disk`: bytes in use on the file system that holds the slave's files."""

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

#: A walk through the directory takes at most this fraction of the time.
_WALK_SHARE: Final = 0.01
#: `st_blocks` counts these, whatever the file system's own block.
_BLOCK: Final = 512


@dataclass(frozen=True)
class DiskOptions:
    """Settings of the probe `disk`.

    Attributes:
        scope: what is measured; None: as the host's configuration says. A control group has no
            disk of its own: it counts as the machine, and so does a slice without a disk budget.
        path: a file or directory on the disk that counts; None: the slave's data directory.
        walk_period: seconds between two walks through the directory of a slice.
    """

    scope: Scope | None = None
    path: str | None = None
    walk_period: Annotated[float, Gt(0)] = 5.0


def create(options: DiskOptions, context: ProbeContext) -> GaugeProbe:
    """Make the probe for the scope that is set."""
    path = Path(options.path) if options.path is not None else context.data_directory
    gauge: Gauge
    if (options.scope or context.scope) == "slice" and "disk" in context.budget:
        gauge = DirectoryTree(path, budget(context, "disk", "bytes"), options.walk_period)
    else:
        gauge = FileSystem(path)
    return GaugeProbe("disk", "B", gauge)


class FileSystem:
    """The file system that a path is on; what is reserved for root is neither used nor free.

    The same figures as `psutil.disk_usage`.

    Args:
        path: need not exist yet: the nearest directory above it then tells the file system.
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
        """Fraction of the file system in use."""
        used, free = self._bytes()
        return used / (used + free) if used + free else 1.0

    def close(self) -> None:
        """Nothing is kept."""

    def _bytes(self) -> tuple[int, int]:
        """Used, and free for anyone."""
        status = os.statvfs(self._path)
        return (
            (status.f_blocks - status.f_bfree) * status.f_frsize,
            status.f_bavail * status.f_frsize,
        )


class DirectoryTree:
    """What lies below a directory, against a budget; walked seldom.

    Args:
        path: of the directory; one that is not there is empty.
        size: bytes, the budget.
        period: seconds between two walks, more where a walk is long.
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
        """Fraction of the budget in use at the last walk."""
        started = self._clock()
        if started >= self._due:
            self._usage = tree_bytes(self._path) / self.capacity
            took = self._clock() - started
            self._due = started + max(self._period, took / _WALK_SHARE)
        return self._usage

    def close(self) -> None:
        """Nothing is kept."""


def tree_bytes(path: str) -> int:
    """Bytes on the disk of all files below a directory; links are not followed."""
    total = 0
    waiting = [path]
    while waiting:
        try:
            entries = os.scandir(waiting.pop())
        except OSError:  # it is gone meanwhile, or not ours to see
            continue
        with entries:
            for entry in entries:
                try:
                    total += entry.stat(follow_symlinks=False).st_blocks * _BLOCK
                    if entry.is_dir(follow_symlinks=False):
                        waiting.append(entry.path)
                except FileNotFoundError:  # deleted meanwhile, as a rotated log is
                    continue
    return total
