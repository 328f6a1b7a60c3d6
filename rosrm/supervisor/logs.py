"""The processes' log files: rotated and bounded, with nothing but `stat` while they are quiet.

A process holds its log open for appending, so a full log is copied and then cut to nothing; what it
writes between the two is lost. A process that floods can exceed the bound by what it writes in one
interval.
"""

from __future__ import annotations

import os
from collections.abc import Collection, Container, Iterable
from typing import Final, NamedTuple

from rosrm.core.supervision import Key
from rosrm.supervisor import own_log, paths

#: Seconds between two looks while logs grow, and while they do not.
BUSY: Final = 0.2
QUIET: Final = 1.0
#: As many processes too many are borne before the logs of the oldest are removed.
PROCESSES_AT_ONCE: Final = 50
#: What may lie beside a log and goes with it.
FILES_BESIDE: Final = (".parameters.yaml",)


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
        self._shelf = Shelf(state)

    def open(self, instance: Key, known: Collection[Key]) -> int:
        """The descriptor that an instance is to write to; makes room by removing old logs.

        Args:
            instance: that is about to start.
            known: instances whose logs stay.
        """
        log = os.open(
            paths.log_file(self._state, *instance),
            os.O_WRONLY | os.O_APPEND | os.O_CREAT | os.O_CLOEXEC,
            0o600,
        )
        self._shelf.add(instance, known, self.limits)
        self._shelf.remove_old_processes(known, self.limits)
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


class Shelf:
    """Which instances have files in the folder of logs; removes those of old ones.

    The folder is read once; from then on the supervisor knows what it put there.
    """

    def __init__(self, state: str) -> None:
        self._state = state
        self._numbers: dict[str, list[int]] = {}
        found = map(paths.log_number, os.listdir(paths.log_folder(state)))
        for name, number in sorted(filter(None, found), key=lambda log: log[1]):
            self._place(name, number)

    def add(self, instance: Key, known: Container[Key], limits: LogLimits) -> None:
        """A new log; makes room for it, but not with the logs of `known` instances."""
        process, number = instance
        numbers = self._place(paths.safe_name(process), number)
        for old in numbers[: max(0, len(numbers) - limits.instances)]:
            if (process, old) not in known:
                numbers.remove(old)
                self._remove(paths.safe_name(process), old)

    def remove_old_processes(self, known: Iterable[Key], limits: LogLimits) -> None:
        """Now and then: the logs of the processes that were started longest ago."""
        excess = len(self._numbers) - limits.processes
        if excess < PROCESSES_AT_ONCE:
            return
        stay = {paths.safe_name(process) for process, _ in known}
        for name in [name for name in self._numbers if name not in stay][:excess]:
            for number in self._numbers.pop(name):
                self._remove(name, number)

    def _place(self, name: str, number: int) -> list[int]:
        """Note a log; its process is now the newest."""
        numbers = self._numbers[name] = self._numbers.pop(name, [])
        if number not in numbers:
            numbers.append(number)
            numbers.sort()
        return numbers

    def _remove(self, name: str, number: int) -> None:
        log = os.path.join(paths.log_folder(self._state), f"{name}.{number}.log")
        for extra in FILES_BESIDE:
            _unlink(f"{log[: -len('.log')]}{extra}")
        _unlink(log)
        older = 1
        while _unlink(f"{log}.{older}"):
            older += 1


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


def _unlink(path: str) -> bool:
    """Remove a file; False: there is none."""
    try:
        os.unlink(path)
    except FileNotFoundError:
        return False
    return True
