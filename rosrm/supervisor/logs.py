"""The processes' log files: rotated and bounded, with nothing but `stat` while they are quiet.

A process holds its log open for appending, so a full log is copied and then cut to nothing; what it
writes between the two is lost. A process that floods can exceed the bound by what it writes in one
interval.
"""

from __future__ import annotations

import os
from collections.abc import Iterable
from typing import Final, NamedTuple

from rosrm.core.supervision import Key
from rosrm.supervisor import own_log, paths

#: Seconds between two looks while logs grow, and while they do not.
BUSY: Final = 0.2
QUIET: Final = 1.0
#: New processes between two looks for logs of old ones.
PRUNE_EVERY: Final = 100


class LogLimits(NamedTuple):
    """How much log is kept.

    Attributes:
        max_bytes: of one file.
        keep: older files beside the current one, for each instance.
        instances: instances of one process whose logs are kept.
        processes: processes whose logs are kept.
    """

    max_bytes: int = 10 << 20
    keep: int = 2
    instances: int = 5
    processes: int = 500


class LogKeeper:
    """Looks after the logs below one state directory."""

    def __init__(self, state: str, limits: LogLimits) -> None:
        self.limits = limits
        self._state = state
        self._sizes: dict[Key, int] = {}
        self._due: float | None = None
        self._new_processes = 0

    def open(self, instance: Key, known: Iterable[Key]) -> int:
        """The descriptor that an instance is to write to; makes room by removing old logs.

        Args:
            instance: that is about to start.
            known: instances whose logs stay.
        """
        process, number = instance
        path = paths.log_file(self._state, process, number)
        try:
            log = _open(path)
        except FileNotFoundError:
            self._prune_processes(known)
            os.mkdir(os.path.dirname(path), mode=0o700)
            return _open(path)
        self._prune_instances(process, known)
        return log

    def watch(self, instance: Key, now: float) -> None:
        """The instance runs."""
        self._sizes[instance] = 0
        self._due = now + BUSY

    def release(self, instance: Key) -> None:
        """The instance has ended: a last look at its log."""
        if self._sizes.pop(instance, None) is not None:
            self._look(instance)
        if not self._sizes:
            self._due = None

    def deadline(self) -> float | None:
        """When the next look is due; None: no process runs."""
        return self._due

    def look(self, now: float) -> None:
        """Rotate what has grown too large."""
        if self._due is None or now < self._due:
            return
        grown = False
        for instance, size in self._sizes.items():
            new = self._look(instance)
            grown = grown or new != size
            self._sizes[instance] = new
        self._due = now + (BUSY if grown else QUIET)

    def _look(self, instance: Key) -> int:
        path = paths.log_file(self._state, *instance)
        try:
            size = os.stat(path).st_size
        except OSError:
            return 0  # somebody removed it; the process writes on into nothing
        if size <= self.limits.max_bytes:
            return size
        try:
            rotate(path, size, self.limits)
        except OSError as error:
            own_log.say(f"{path} was cut, but not kept: {error}")
        return 0

    def _prune_instances(self, process: str, known: Iterable[Key]) -> None:
        """Remove the logs of all but the newest instances of a process."""
        directory = paths.log_directory(self._state, process)
        files: dict[int, list[str]] = {}
        for name in os.listdir(directory):
            number = name.partition(".")[0]
            if number.isdigit():
                files.setdefault(int(number), []).append(name)
        excess = len(files) - self.limits.instances
        if excess <= 0:
            return
        stay = {number for name, number in known if name == process}
        for old in set(sorted(files)[:excess]) - stay:
            for name in files[old]:
                os.unlink(os.path.join(directory, name))

    def _prune_processes(self, known: Iterable[Key]) -> None:
        """Once in many new processes, remove the logs of those that wrote longest ago."""
        self._new_processes += 1
        if self._new_processes % PRUNE_EVERY:
            return
        directory = paths.log_root(self._state)
        stay = {paths.safe_name(name) for name, _ in known}
        old = [os.path.join(directory, name) for name in os.listdir(directory) if name not in stay]
        old.sort(key=lambda path: os.stat(path).st_mtime)
        for path in old[: max(0, len(old) - self.limits.processes)]:
            for name in os.listdir(path):
                os.unlink(os.path.join(path, name))
            os.rmdir(path)


def rotate(path: str, size: int, limits: LogLimits) -> None:
    """Keep the newest `max_bytes` of a log aside and cut it to nothing."""
    for number in range(limits.keep - 1, 0, -1):
        if os.path.exists(f"{path}.{number}"):
            os.replace(f"{path}.{number}", f"{path}.{number + 1}")
    with open(path, "rb+", buffering=0) as log:
        try:
            if limits.keep > 0:
                _copy_end(log.fileno(), f"{path}.1", size, limits.max_bytes)
        finally:
            log.truncate(0)  # above all when the disk is full


def _copy_end(log: int, target: str, size: int, most: int) -> None:
    offset = max(0, size - most)
    with open(target, "wb", buffering=0) as copy:
        if offset:
            copy.write(b"[rosrm: %d bytes before this were dropped]\n" % offset)
        while offset < size:
            sent = os.sendfile(copy.fileno(), log, offset, size - offset)
            if sent == 0:
                break
            offset += sent


def _open(path: str) -> int:
    return os.open(path, os.O_WRONLY | os.O_APPEND | os.O_CREAT | os.O_CLOEXEC, 0o600)
