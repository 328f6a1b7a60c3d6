"""Writes the record of a master's run, beside the loop that decides.

The loop only puts what happened into a queue; a thread encodes and writes it. A record is bounded
in size, and whatever goes wrong with it ends the record, never the master.
"""

from __future__ import annotations

import logging
import os
import queue
import re
import threading
from collections.abc import Sequence
from pathlib import Path
from typing import BinaryIO, Final, NamedTuple

from rosrm.core.master.commands import Command
from rosrm.core.master.events import Event, ReadingsReceived, StatusesReceived, UsagesReceived
from rosrm.errors import ConfigError
from rosrm.recording.encoding import decisions, encode, encode_decisions
from rosrm.recording.frames import FrameKind, frame, opening
from rosrm.recording.reader import Header

_log = logging.getLogger("rosrm.master")

#: Bytes of memory that may wait to be written, as `_weight` counts them; a disk that falls further
#: behind ends the record. At a thousand hosts it is more than a minute.
_BACKLOG: Final = 256 * 2**20
#: Bytes that an event takes beside its readings, and each status or command that comes with it.
_EACH: Final = 1536
#: Seconds that the end of the master waits for what is still to be written.
_LAST_WORDS: Final = 10.0
_SUFFIX: Final = ".rosrec"


class _Noted(NamedTuple):
    event: Event
    now: float
    wall: float
    commands: Sequence[Command]
    weight: int


class Recorder:
    """The record of one run of a master.

    Args:
        directory: for the file, `MASTER-EPOCH.rosrec`; it is made where it does not exist.
        header: what the master begins with.
        max_size: bytes; a record that would be larger ends there.
        keep: files of this master kept in the directory, this one included; older ones are deleted.

    Raises:
        ConfigError: the file cannot be written.
    """

    def __init__(self, directory: Path, header: Header, max_size: int, keep: int) -> None:
        self._max_size = max_size
        self._queue: queue.SimpleQueue[_Noted | None] = queue.SimpleQueue()
        self._why = ""
        self._put = self._done = 0  # bytes; the first is the loop's, the second the thread's
        try:
            directory.mkdir(parents=True, exist_ok=True, mode=0o700)
            _make_room(directory, header.master, keep - 1)
            self.path, self._file = _new_file(directory, f"{header.master}-{header.epoch:04d}")
            self._size = self._file.write(opening())
            self._size += self._file.write(frame(FrameKind.HEADER, header.encoded()))
            self._file.flush()
        except OSError as error:
            raise ConfigError(
                f"record: nothing can be written into {directory}: {error.strerror}. Give another "
                f"`record.directory`, or leave it out to record nothing"
            ) from None
        self._thread = threading.Thread(target=self._write, name="rosrm recorder", daemon=True)
        self._thread.start()

    @property
    def waiting(self) -> int:
        """Bytes of memory, roughly, of what waits to be written."""
        return self._put - self._done

    def note(self, event: Event, now: float, wall: float, commands: Sequence[Command]) -> None:
        """Something happened, and this came of it; returns at once."""
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
        """Write what waits and the end of the record; `why` the master ends."""
        if not self._why:
            self._why = why
        self._queue.put(None)
        self._thread.join(_LAST_WORDS)
        if self._thread.is_alive():
            _log.warning("the record %s was not written to its end", self.path)

    def _end(self, why: str) -> None:
        """Nothing more is recorded, and that is said."""
        self._why = why
        self._queue.put(None)
        _log.warning("the record %s ends here: %s", self.path, why)

    # --- the thread ----------------------------------------------------------------------

    def _write(self) -> None:
        try:
            with self._file:
                self._write_events()
                self._file.write(frame(FrameKind.END, self._why.encode()))
        except Exception as fault:  # noqa: BLE001 - whatever it is, it must not go unseen
            self._why = self._why or "failed"
            _log.warning("the record %s ends here: %s", self.path, _told(fault))
        finally:
            self._forget()

    def _write_events(self) -> None:
        while (noted := self._queue.get()) is not None:
            self._done += noted.weight
            try:
                written = _encoded(noted)
            except Exception as fault:  # noqa: BLE001 - a bug in here is no reason to lose the rest
                self._end(f"failed: {_told(fault)}, at {type(noted.event).__name__}")
                return
            if self._size + len(written) > self._max_size:
                self._end(f"full: it has reached `record.max_size`, {self._max_size} bytes")
                return
            self._size += self._file.write(written)
            if self._queue.empty():
                self._file.flush()

    def _forget(self) -> None:
        """Nobody writes what still waits: it need not be held until the master ends."""
        while not self._queue.empty():
            noted = self._queue.get()
            self._done += 0 if noted is None else noted.weight


def _weight(event: Event, commands: Sequence[Command]) -> int:
    """Bytes of memory that an event and its commands hold until they are written, roughly.

    What is submitted is held by the master anyway.
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
    """The frames of an event and of what was decided."""
    written = frame(*encode(noted.event, noted.now, noted.wall))
    decided = decisions(noted.commands)
    if decided:
        written += frame(FrameKind.DECISIONS, encode_decisions(decided))
    return written


def _told(fault: Exception) -> str:
    """What went wrong, in words."""
    if isinstance(fault, OSError):
        return fault.strerror or str(fault)
    return f"{type(fault).__name__}: {fault}"


def _new_file(directory: Path, stem: str) -> tuple[Path, BinaryIO]:
    """A file that nobody has; readable by its owner alone, as it holds all that was submitted."""
    path, number = directory / f"{stem}{_SUFFIX}", 1
    while True:
        try:
            descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600)
            return path, os.fdopen(descriptor, "wb")
        except FileExistsError:  # an epoch comes again when the journal was lost
            number += 1
            path = directory / f"{stem}.{number}{_SUFFIX}"


def _make_room(directory: Path, master: str, keep: int) -> None:
    """Delete the oldest records of a master beyond so many."""
    found = [path for path in directory.glob(f"*{_SUFFIX}") if _is_of(path, master)]
    oldest_first = sorted(found, key=lambda path: path.stat().st_mtime_ns)
    for path in oldest_first[: max(0, len(oldest_first) - keep)]:
        path.unlink()


def _is_of(path: Path, master: str) -> bool:
    return re.fullmatch(rf"{re.escape(master)}-\d{{4,}}(\.\d+)?", path.stem) is not None
