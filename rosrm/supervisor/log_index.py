"""Index of a log: bytes written by a time, and the starts of programs.

Beside each log file lies `FILE.times`: records of 24 bytes, ascending::

    time      float64   unix time by this host's clock, seconds
    offset    uint64    bytes that the instance had written by then, since its first start
    pid       uint64    of the process that was started there; 0: a mere check of the log

The offset of the first record is that of the file's first byte. So a rotation changes no offset,
and the reader notices dropped output.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Callable
from typing import TYPE_CHECKING, Final, NamedTuple

from rosrm.runtime import durable
from rosrm.runtime.private_files import open_private

if TYPE_CHECKING:
    from typing_extensions import Self

_RECORD: Final = struct.Struct("<dQQ")
#: Unix time before which times of output are (year 2242).
_LATEST: Final = float(1 << 33)


class Mark(NamedTuple):
    """One record."""

    time: float
    offset: int
    pid: int


def is_possible(time: float) -> bool:
    """Return True if a unix time can be one of a log; other hosts may send any, also NaN."""
    return 0.0 < time < _LATEST


def marks_in(content: bytes) -> list[Mark]:
    """Return the records in bytes of an index file; an incomplete last one is left out."""
    whole = len(content) // _RECORD.size * _RECORD.size
    return [Mark(*record) for record in _RECORD.iter_unpack(content[:whole])]


def path_of(log: str) -> str:
    """Return the path of the index of a log file."""
    return f"{log}.times"


def add(log: str, mark: Mark) -> None:
    """Append a record; a start replaces the one before it if nothing was written in between."""
    index = open_private(path_of(log), os.O_RDWR | os.O_CREAT)
    try:
        end = os.fstat(index).st_size // _RECORD.size * _RECORD.size
        if mark.pid and end:
            before = Mark(*_RECORD.unpack(os.pread(index, _RECORD.size, end - _RECORD.size)))
            if before.pid and before.offset == mark.offset:
                end -= _RECORD.size
        os.pwrite(index, _RECORD.pack(*mark), end)
    finally:
        os.close(index)


def size(log: str) -> int:
    """Return the bytes of the index of a log file; 0: it has none."""
    try:
        return os.stat(path_of(log)).st_size
    except OSError:
        return 0


def begin(log: str, mark: Mark, rest: bytes = b"") -> None:
    """Replace the index of a log file, as a whole."""
    os.close(durable.replace_atomically(path_of(log), _RECORD.pack(*mark) + rest))


def base(log: str) -> int | None:
    """Return the offset of the first byte of a log file; None: it has no index."""
    with Index(log) as index:
        return index.mark(0).offset if index.count else None


def copy_from(log: str, offset: int, target: str) -> None:
    """Give the file `target` the index of the part of `log` that begins at `offset`."""
    with Index(log) as index:
        first = index.find(lambda mark: mark.offset > offset)
        when = index.mark(max(0, first - 1)).time if index.count else 0.0
        begin(target, Mark(when, offset, 0), index.bytes_from(first))


class Index:
    """The records of one log file; a context manager. A file without an index has none."""

    def __init__(self, log: str) -> None:
        try:
            self._file = os.open(path_of(log), os.O_RDONLY | os.O_CLOEXEC)
            self.count = os.fstat(self._file).st_size // _RECORD.size
        except FileNotFoundError:
            self._file, self.count = -1, 0

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if self._file >= 0:
            os.close(self._file)

    def mark(self, number: int) -> Mark:
        """Return one record, counted from 0."""
        at = number * _RECORD.size
        return Mark(*_RECORD.unpack(os.pread(self._file, _RECORD.size, at)))

    def find(self, is_late: Callable[[Mark], bool]) -> int:
        """Return the number of the first record for which `is_late` is true, or `count`."""
        low, high = 0, self.count
        while low < high:
            middle = (low + high) // 2
            if is_late(self.mark(middle)):
                high = middle
            else:
                low = middle + 1
        return low

    def bytes_from(self, first: int) -> bytes:
        """Return the records from `first` on as the bytes of the index file."""
        length = (self.count - first) * _RECORD.size
        return os.pread(self._file, length, first * _RECORD.size) if length > 0 else b""

    def marks(self, first: int, most: int) -> list[Mark]:
        """Return at most `most` records from `first` on."""
        most = min(most, self.count - first)
        if most <= 0:
            return []
        return marks_in(os.pread(self._file, most * _RECORD.size, first * _RECORD.size))
