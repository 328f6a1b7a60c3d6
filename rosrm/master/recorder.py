"""Recording of a master's run, written by a separate thread.

The master's loop only queues events; the thread encodes and writes them. A recording is bounded in
size. Any error ends the recording, never the master.
"""

from __future__ import annotations

import logging
import os
import queue
import re
from collections.abc import Sequence
from pathlib import Path
from typing import BinaryIO, Final, NamedTuple

from rosrm import threads
from rosrm.core.master.commands import Command
from rosrm.core.master.events import Event, ReadingsReceived, StatusesReceived, UsagesReceived
from rosrm.errors import ConfigError
from rosrm.recording.encoding import decisions, encode, encode_decisions
from rosrm.recording.frames import FrameKind, frame, opening
from rosrm.recording.reader import Header
from rosrm.runtime.private_files import make_safe_directory
from rosrm.wording import reason_of

_log = logging.getLogger("rosrm.master")

#: Most bytes of memory in the queue, as `_weight` counts them; a disk that falls further behind
#: ends the recording. With a thousand hosts the queue holds more than a minute.
_BACKLOG: Final = 256 * 2**20
#: Bytes of an event without its readings, and of each of its statuses and commands.
_EACH: Final = 1536
#: Seconds for which the end of the master waits for the queue to be written.
_LAST_WORDS: Final = 10.0
_SUFFIX: Final = ".rosrec"


class _Noted(NamedTuple):
    event: Event
    now: float
    wall: float
    commands: Sequence[Command]
    weight: int


class Recorder:
    """Recording of one run of a master.

    Args:
        directory: for the file `MASTER-EPOCH.rosrec`; created if it does not exist.
        header: initial state of the master.
        max_size: most bytes; a recording that would be larger ends.
        keep: most recordings of this master in the directory, this one included; older ones are
            deleted.

    Raises:
        ConfigError: the file cannot be written.
    """

    def __init__(self, directory: Path, header: Header, max_size: int, keep: int) -> None:
        self._max_size = max_size
        self._queue: queue.SimpleQueue[_Noted | None] = queue.SimpleQueue()
        self._why = ""
        self._put = self._done = 0  # bytes; the first is the loop's, the second the thread's
        try:
            make_safe_directory(directory)
            _make_room(directory, header.master, keep - 1)
            self.path, self._file = _new_file(directory, f"{header.master}-{header.epoch:04d}")
            self._size = self._file.write(opening())
            self._size += self._file.write(frame(FrameKind.HEADER, header.encoded()))
            self._file.flush()
        except OSError as error:
            raise ConfigError(
                f"record: nothing can be written into {directory}: {reason_of(error)}. Give "
                f"another `record.directory`, or leave it out to record nothing"
            ) from None
        self._thread = threads.start(self._write, "rosrm recorder")

    @property
    def waiting(self) -> int:
        """Return the approximate bytes of memory in the queue."""
        return self._put - self._done

    def note(self, event: Event, now: float, wall: float, commands: Sequence[Command]) -> None:
        """Queue an event with the commands decided on it; returns at once."""
        if self._why:
            return
        weight = _weight(event, commands)
        if self.waiting + weight > _BACKLOG:
            self._end(
                f"full: the disk could not keep up: {self.waiting / 2**20:.0f} MiB of events waited"
            )
            return
        self._put += weight
        self._queue.put(_Noted(event, now, wall, commands, weight))

    def close(self, why: str) -> None:
        """Write the queue and the end of the recording, with the reason why the master ends."""
        if not self._why:
            self._why = why
        self._queue.put(None)
        self._thread.join(_LAST_WORDS)
        if self._thread.is_alive():
            _log.warning("the record %s was not written to its end", self.path)

    def _end(self, why: str) -> None:
        """End the recording, and log the reason."""
        self._why = why
        self._queue.put(None)
        _log.warning("the record %s ends here: %s", self.path, why)

    # --- the thread ----------------------------------------------------------------------

    def _write(self) -> None:
        try:
            with self._file:
                self._write_events()
                self._file.write(frame(FrameKind.END, self._why.encode()))
        except Exception as fault:  # noqa: BLE001 - every error must be logged
            self._why = self._why or "failed"
            _log.warning("the record %s ends here: %s", self.path, _describe(fault))
        finally:
            self._forget()

    def _write_events(self) -> None:
        while (noted := self._queue.get()) is not None:
            self._done += noted.weight
            try:
                written = _encoded(noted)
            except Exception as fault:  # noqa: BLE001 - a bug here must not lose the other events
                self._end(f"failed: {_describe(fault)}, at {type(noted.event).__name__}")
                return
            if self._size + len(written) > self._max_size:
                self._end(f"full: it has reached `record.max_size`, {self._max_size} bytes")
                return
            self._size += self._file.write(written)
            if self._queue.empty():
                self._file.flush()

    def _forget(self) -> None:
        """Empty the queue after the end of the recording, to free its memory."""
        while not self._queue.empty():
            noted = self._queue.get()
            self._done += 0 if noted is None else noted.weight


def _weight(event: Event, commands: Sequence[Command]) -> int:
    """Return the approximate bytes of memory that an event and its commands hold until written.

    Submitted specs do not count, because the master holds them anyway.
    """
    weight = _EACH * (1 + len(commands))
    if isinstance(event, ReadingsReceived):
        return weight + event.usage.nbytes + event.limit.nbytes + 5 * event.host_id.nbytes
    if isinstance(event, UsagesReceived):
        return weight + 3 * event.numbers.nbytes
    if isinstance(event, StatusesReceived):
        return weight + _EACH * len(event.statuses)
    return weight


def _encoded(noted: _Noted) -> bytes:
    """Return the frames of an event and of the decisions on it."""
    written = frame(*encode(noted.event, noted.now, noted.wall))
    decided = decisions(noted.commands)
    if decided:
        written += frame(FrameKind.DECISIONS, encode_decisions(decided))
    return written


def _describe(fault: Exception) -> str:
    """Return a description of an exception."""
    if isinstance(fault, OSError):
        return reason_of(fault)
    return f"{type(fault).__name__}: {fault}"


def _new_file(directory: Path, stem: str) -> tuple[Path, BinaryIO]:
    """Create a new file, readable by its owner alone, because it holds all submitted specs."""
    path, number = directory / f"{stem}{_SUFFIX}", 1
    while True:
        try:
            descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600)
            return path, os.fdopen(descriptor, "wb")
        except FileExistsError:  # an epoch is repeated if the journal was lost
            number += 1
            path = directory / f"{stem}.{number}{_SUFFIX}"


def _make_room(directory: Path, master: str, keep: int) -> None:
    """Delete the oldest recordings of a master beyond `keep`."""
    found = [path for path in directory.glob(f"*{_SUFFIX}") if _is_of(path, master)]
    oldest_first = sorted(found, key=lambda path: path.stat().st_mtime_ns)
    for path in oldest_first[: max(0, len(oldest_first) - keep)]:
        path.unlink()


def _is_of(path: Path, master: str) -> bool:
    return re.fullmatch(rf"{re.escape(master)}-\d{{4,}}(\.\d+)?", path.stem) is not None
