"""Log files of the processes: rotated, bounded, and checked with a mere `stat` while quiet.

A process holds its log open for appending. So the supervisor copies a full log and then truncates
it; output between the copy and the truncation is lost. A flooding process can exceed the bound by
its output of one interval. Dropped output shows in the offsets of the index beside each file
(`log_index`). The index also holds the time of output: each check that finds a log grown adds a
record. The first such check creates the index, because a program without output needs none.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Container, Iterable, Mapping
from typing import Final, NamedTuple

from rosrm import clocks
from rosrm.core.supervisor.instance import Instance
from rosrm.core.supervisor.rules import Key
from rosrm.model.start_trace import LINE
from rosrm.runtime.private_files import open_private
from rosrm.supervisor import log_index, own_log, paths
from rosrm.supervisor.log_index import Mark
from rosrm.wording import reason_of

#: Seconds between two checks while logs grow, and while they do not.
BUSY: Final = 0.2
QUIET: Final = 1.0
#: Excess of processes at which the logs of the oldest ones are removed.
PROCESSES_AT_ONCE: Final = 50
#: Part of the bound on all logs that may be written until it is applied.
EXCESS_PART: Final = 32
#: Most older files of one instance: a rotation renames each.
MOST_KEPT: Final = 1000
#: Suffixes of files that may lie beside a log and are removed with it.
FILES_BESIDE: Final = (".parameters.yaml", ".key")


class LogLimits(NamedTuple):
    """Limits of the logs that are kept.

    Attributes:
        max_bytes: of one file, and of its index; beyond either the log is rotated.
        keep: older files beside the current one, for each instance.
        instances: instances of one process whose logs are kept.
        processes: processes whose logs are kept.
        keep_bytes: of all logs; files of instances that have not ended may exceed it.
    """

    max_bytes: int = 10 << 20
    keep: int = 2
    instances: int = 5
    processes: int = 500
    keep_bytes: int = 2_000_000_000

    @classmethod
    def bounded(
        cls, max_bytes: int, keep: int, instances: int, processes: int, keep_bytes: int
    ) -> LogLimits:
        """Return received limits, each within the range that the supervisor can hold."""
        return cls(
            max(max_bytes, 1), min(max(keep, 0), MOST_KEPT), max(instances, 1),
            max(processes, 1), max(keep_bytes, 1),
        )  # fmt: skip


class LogKeeper:
    """Opens, watches, rotates and removes the logs below one state directory.

    Args:
        state: the state directory.
        limits: limits of the logs.
        known: all instances of the supervisor, which may change them in another thread. Until an
            instance has ended, its log stays, with the files that its next start needs.
    """

    def __init__(self, state: str, limits: LogLimits, known: Mapping[Key, Instance]) -> None:
        self.limits = limits
        self._known = known
        self._state = state
        self._logs: dict[Key, _Log] = {}
        self._opened: dict[Key, int] = {}
        self._prepared: dict[Key, int] = {}  # descriptors of logs that were opened ahead
        self._due: float | None = None
        self._read_folder: LogFolder | None = None
        self._unchecked = limits.keep_bytes  # bytes that may lie there from earlier

    @property
    def _folder(self) -> LogFolder:
        if self._read_folder is None:
            self._read_folder = LogFolder(self._state)
        return self._read_folder

    def prepare(self, instance: Key) -> None:
        """Open the log of an instance ahead of its start, for the next `open`.

        No older log is removed yet, because the instance may never start.
        """
        with contextlib.suppress(OSError):  # `open` tries again, and reports the fault
            self._prepared[instance] = self._open(instance)

    def open(self, instance: Key) -> int:
        """Open the log of a starting instance, and make room for it.

        Raises:
            OSError: the log cannot be opened. An old log that cannot be removed prevents no start.
        """
        log = self._prepared.pop(instance, None)
        if log is not None and not os.fstat(log).st_nlink:  # a user has removed the file
            os.close(log)
            log = None
        if log is None:
            log = self._open(instance)
        try:
            self._folder.add(instance, self._known, self.limits)
            self._folder.remove_old_processes(self._known, self.limits)
        except OSError as error:
            own_log.write(f"an old log cannot be removed: {error}")
        return log

    def _open(self, instance: Key) -> int:
        path = paths.log_file(self._state, *instance)
        log = open_private(path, os.O_WRONLY | os.O_APPEND | os.O_CREAT)
        self._opened[instance] = os.fstat(log).st_size
        return log

    def note_adoption(self, instance: Key, pid: int) -> None:
        """Write into the log of an adopted process where its output goes."""
        try:
            output = os.readlink(f"/proc/{pid}/fd/1")
        except OSError:
            output = "its former output"
        text = (
            f"rosrm: process {pid} was adopted, and still writes to {output}, not to this log; "
            "its output is here from its first restart on\n"
        )
        try:
            log = self.open(instance)
            with open(log, "wb") as file:
                file.write(os.fsencode(text))
        except OSError as error:
            own_log.write(f"the log of an adopted process cannot be written: {error}")

    def watch(self, instance: Key, now: float, started: int = 0) -> None:
        """Begin to check the log of a running instance.

        `started` is the pid of the process that was started after `open`; 0: it ran before.
        """
        log = self._logs[instance] = _Log(paths.log_file(self._state, *instance))
        opened = self._opened.pop(instance, 0)
        if started:
            log.begin(opened, started)
        self._due = now + BUSY

    def release(self, instance: Key) -> None:
        """Check the log of an ended instance a last time and stop watching it.

        Remove the log that was opened ahead for an instance that never started.
        """
        opened, prepared = self._opened.pop(instance, 0), self._prepared.pop(instance, None)
        if prepared is not None:
            os.close(prepared)
            if not opened:
                with contextlib.suppress(OSError):  # an empty file may stay
                    _unlink(paths.log_file(self._state, *instance))
        log = self._logs.pop(instance, None)
        if log is not None:
            self._unchecked += log.look(self.limits)
        if not self._logs:
            self._due = None
        self._remove_excess()

    def deadline(self) -> float | None:
        """Return the monotonic time of the next check; None: no process runs."""
        return self._due

    def look(self, now: float) -> None:
        """Check all logs if a check is due, and rotate those that exceed the limits."""
        if self._due is None or now < self._due:
            return
        grown = sum(log.look(self.limits) for log in self._logs.values())
        self._due = now + (BUSY if grown else QUIET)
        self._unchecked += grown
        self._remove_excess()

    def _remove_excess(self) -> None:
        """Apply the bound on all logs, once enough was written since the last time."""
        if self._unchecked < self.limits.keep_bytes // EXCESS_PART:
            return
        self._unchecked = 0
        stay = [key for key, one in tuple(self._known.items()) if not one.ended]
        try:
            self._folder.remove_excess(stay, self.limits.keep_bytes)
        except OSError as error:
            own_log.write(f"an old log cannot be removed: {error}")


class _Log:
    """The log of a running instance.

    Attributes:
        base: bytes that the instance had written before the first one in the current file.
        size: bytes in the current file that are in the index.
    """

    def __init__(self, path: str) -> None:
        self.path = path
        self.base, self.size, self._has_index = 0, 0, False
        try:
            with log_index.Index(path) as index:
                if index.count:
                    self.base = index.mark(0).offset
                    self.size = index.mark(index.count - 1).offset - self.base
                    self._has_index = True
        except OSError as error:  # a log without times is no reason against a start
            own_log.write(f"the time index of {path} cannot be read: {error}")
        self._start: Mark | None = None  # of a program without output and index

    def begin(self, size: int, pid: int) -> None:
        """Record the start of a program at the end of the log file, which has `size` bytes."""
        if size or self._has_index:
            self.note(size, pid)
        else:
            self._start = Mark(clocks.wall_time(), self.base, pid)

    def look(self, limits: LogLimits) -> int:
        """Record growth in the index, and rotate a log over its limits; return the new bytes."""
        try:
            size = os.stat(self.path).st_size
        except OSError:
            return 0  # the log was removed; the process writes into a file without a name
        if size == self.size:
            return 0
        grown = abs(size - self.size)
        self.note(size, 0)
        if size > limits.max_bytes or log_index.size(self.path) > limits.max_bytes:
            try:
                rotate(self.path, size, limits)
            except OSError as error:
                own_log.write(f"{self.path} was truncated, but not rotated: {error}")
            with contextlib.suppress(OSError):  # `note` finds that the log is shorter
                self.base, self.size = log_index.base(self.path) or 0, 0
        return grown

    def note(self, size: int, pid: int) -> None:
        """Record in the index that the log file now has `size` bytes."""
        now = clocks.wall_time()
        if size < self.size:
            # The log was truncated by hand, or by a supervisor killed before a new index.
            self.base += self.size
            self._has_index = False
        self.size = size
        try:
            if self._start is not None:
                log_index.add(self.path, self._start)
                self._start = None
            elif not self._has_index and self.base + size > 0:
                log_index.begin(self.path, Mark(now, self.base, 0))
            log_index.add(self.path, Mark(now, self.base + size, pid))
            self._has_index = True
        except OSError as error:
            own_log.write(f"the time index of {self.path} was not written: {error}")


def note_trace(log: int, stamps: str) -> None:
    """Write the trace of a start into the log of its process."""
    with contextlib.suppress(OSError):  # the disk is full
        os.write(log, os.fsencode(f"{LINE}{stamps}\n"))


class LogFolder:
    """The instances that have files in the log folder; removes the files of old instances.

    The folder is read once; from then on the supervisor tracks the files that it creates.
    """

    def __init__(self, state: str) -> None:
        self._state = state
        self._numbers: dict[str, list[int]] = {}
        self._left = 0  # processes after the last removal
        try:
            names = os.listdir(paths.log_folder(state))
        except OSError as error:  # its old logs stay until the next supervisor
            own_log.write(f"{paths.log_folder(state)} cannot be listed: {reason_of(error)}")
            names = []
        found = map(paths.log_number, names)
        for name, number in sorted(filter(None, found), key=lambda log: log[1]):
            self._place(name, number)

    def add(self, instance: Key, known: Container[Key], limits: LogLimits) -> None:
        """Add a new log; make room for it, but keep the logs of `known` instances."""
        process, number = instance
        numbers = self._place(paths.safe_name(process), number)
        for old in numbers[: max(0, len(numbers) - limits.instances)]:
            if (process, old) not in known:
                numbers.remove(old)
                self._remove(paths.safe_name(process), old)

    def remove_old_processes(self, known: Iterable[Key], limits: LogLimits) -> None:
        """Remove the logs of the processes started longest ago, once the excess is large enough."""
        processes = len(self._numbers)
        excess = processes - limits.processes
        # Logs of known processes stay. Without the second bound, each start would search them all
        # again.
        if excess < PROCESSES_AT_ONCE or processes < self._left + PROCESSES_AT_ONCE:
            return
        stay = {paths.safe_name(process) for process, _ in tuple(known)}  # the loop may change it
        for name in [name for name in self._numbers if name not in stay][:excess]:
            for number in self._numbers.pop(name):
                self._remove(name, number)
        self._left = len(self._numbers)

    def remove_excess(self, not_ended: Iterable[Key], keep_bytes: int) -> None:
        """Remove logs until their bytes are within a bound, those of old processes first.

        First go the logs of instances that have ended, then the older files of the others.
        """
        sizes = self._sizes()
        total = sum(map(sum, (files.values() for files in sizes.values())))
        stay = {(paths.safe_name(process), number) for process, number in not_ended}
        order = [(name, number) for name, numbers in self._numbers.items() for number in numbers]
        for name, number in order:
            if total > keep_bytes and (name, number) not in stay:
                total -= sum(sizes.get((name, number), {}).values())
                self._numbers[name].remove(number)
                self._remove(name, number)
        for at in filter(stay.__contains__, order):
            files = sizes.get(at, {})
            for file in sorted(files, key=paths.age_of, reverse=True):
                if total > keep_bytes and paths.age_of(file):
                    total -= files[file]
                    _unlink(os.path.join(paths.log_folder(self._state), file))
        self._numbers = {name: numbers for name, numbers in self._numbers.items() if numbers}

    def _sizes(self) -> dict[tuple[str, int], dict[str, int]]:
        """Return the bytes of each file of each instance."""
        sizes: dict[tuple[str, int], dict[str, int]] = {}
        with os.scandir(paths.log_folder(self._state)) as files:
            for file in files:
                at = paths.instance_of(file.name)
                if at is not None:
                    with contextlib.suppress(OSError):  # a process may remove its own files
                        size = file.stat(follow_symlinks=False).st_size
                        sizes.setdefault(at, {})[file.name] = size
        return sizes

    def _place(self, name: str, number: int) -> list[int]:
        """Add a log, mark its process as the newest, and return its instance numbers."""
        numbers = self._numbers[name] = self._numbers.pop(name, [])
        if number not in numbers:
            numbers.append(number)
            numbers.sort()
        return numbers

    def _remove(self, name: str, number: int) -> None:
        log = os.path.join(paths.log_folder(self._state), f"{name}.{number}.log")
        for extra in FILES_BESIDE:
            _unlink(f"{log[: -len('.log')]}{extra}")
        _unlink(log_index.path_of(log))
        _unlink(log)
        older = 1
        while _unlink(f"{log}.{older}"):
            _unlink(log_index.path_of(f"{log}.{older}"))
            older += 1


def rotate(path: str, size: int, limits: LogLimits) -> None:
    """Copy the newest `max_bytes` of a log of `size` bytes to a file beside it, and truncate it."""
    base = log_index.base(path) or 0
    start = max(0, size - limits.max_bytes)
    with open(path, "rb+", buffering=0) as log:
        try:
            if limits.keep > 0:
                _copy(log.fileno(), f"{path}.new", start, size)
                log_index.copy_from(path, base + start, f"{path}.new")
                for number in range(limits.keep - 1, 0, -1):
                    _rename(f"{path}.{number}", f"{path}.{number + 1}")
                _rename(f"{path}.new", f"{path}.1")
        finally:
            # First, also if the copy failed, above all because the disk is full.
            written = os.fstat(log.fileno()).st_size
            log.truncate(0)
            with contextlib.suppress(OSError):  # of the user, who may have made a folder of it
                _unlink(f"{path}.new")
            log_index.begin(path, Mark(clocks.wall_time(), base + written, 0))


def _copy(log: int, target: str, offset: int, end: int) -> None:
    copy = open_private(target, os.O_WRONLY | os.O_TRUNC | os.O_CREAT)
    try:
        while offset < end:
            sent = os.sendfile(copy, log, offset, end - offset)
            if sent == 0:
                break
            offset += sent
    finally:
        os.close(copy)


def _rename(log: str, to: str) -> None:
    """Rename a log file together with its index, where one exists."""
    for source, target in ((log, to), (log_index.path_of(log), log_index.path_of(to))):
        with contextlib.suppress(FileNotFoundError):
            os.replace(source, target)


def _unlink(path: str) -> bool:
    """Remove a file; return False if there is none."""
    try:
        os.unlink(path)
    except FileNotFoundError:
        return False
    return True
