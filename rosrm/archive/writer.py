"""Writer of a log archive: appends, compresses and removes.

Bytes are appended only at the end of the stored log of a source, and that end is read from the
file. So a crash at any moment loses no byte and stores none twice: the collector requests bytes
again that were not written. A loss of power may leave the size of a file, or its newest blocks,
without the bytes before: zeros. So appended bytes are forced to the disk, and those from a zero in
the last append on are in doubt at the start: the host sends them again, if it still has them.
"""

from __future__ import annotations

import gzip
import os
import zlib
from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Final

from rosrm.archive.layout import (
    Segment,
    Source,
    host_folder,
    is_own_name,
    path_of,
    read_segments,
    segment_at,
)
from rosrm.archive.retention import ArchiveLimits, excess, is_within
from rosrm.model.rows import LARGEST_LOG_PART, LogPart
from rosrm.runtime import durable
from rosrm.runtime.private_files import make_private_directory, open_private
from rosrm.supervisor import log_index
from rosrm.supervisor.log_index import Mark

#: Bytes of a segment, or of its index, beyond which it is closed.
SEGMENT_BYTES: Final = 4 << 20
#: Part of the bound that may be written until the bounds are applied.
_EXCESS_PART: Final = 64
#: Empty segments, which remember the positions of sources whose logs were removed.
_MOST_EMPTY: Final = 100_000


class ArchiveWriter:
    """Writes a log archive; one writer at a time, and the caller holds the lock.

    Args:
        directory: of the archive; created if it is missing.
        limits: bounds of the archive.

    Raises:
        OSError: the directory cannot be used.
    """

    def __init__(self, directory: Path, limits: ArchiveLimits) -> None:
        make_private_directory(directory)
        make_private_directory(directory / "hosts")
        self._directory, self._limits = directory, limits
        self.read_again()
        self._remove_remains()

    def read_again(self) -> None:
        """Read the segments again, e.g. after a user removed files; raises `OSError`."""
        self._segments = read_segments(self._directory)
        self._unchecked = self._limits.keep
        self._doubted = {
            source: zero for source, (*_, last) in self._segments.items()
            if last.is_open and (zero := _first_zero(last)) >= 0
        }  # fmt: skip

    def position(self, source: Source) -> int:
        """Return the offset of the next byte of a source, or of one in doubt: a zero."""
        last = self._last(source)
        return self._doubted.get(source, last.end) if last is not None else 0

    def newest_content(self, source: Source) -> tuple[int, bytes]:
        """Return offset and bytes of the newest segment of a source; raises `OSError`."""
        last = self._last(source)
        if last is None:
            return 0, b""
        content = last.path.read_bytes()
        try:
            return last.begin, content if last.is_open else gzip.decompress(content)
        except (gzip.BadGzipFile, EOFError, zlib.error):  # damaged
            return last.end, b""

    def begin_generation(self, source: Source) -> None:
        """Continue at offset 0: the host holds another log of the same number; raises `OSError`."""
        last = self._last(source)
        if last is not None:
            self.close(source)
            self._create(source, last.generation + 1, 0)

    def add(self, source: Source, part: LogPart) -> None:
        """Append a part of a log, at or after `position`.

        Raises:
            OSError: the disk is full, for example; a beginning of the part may be stored.
            ValueError: the part is before the position.
        """
        position = self.position(source)
        if part.offset < position:
            raise ValueError(f"offset {part.offset}, but {position} bytes are stored")
        if not part.content:
            return
        part = self._without_doubt(source, part)
        segment = self._open_at(source, part.offset)
        before = segment.room
        try:
            _add_marks(segment, part)
            durable.append_durably(str(segment.path), part.content)
        finally:
            self._refresh(source, segment)
        segment = self._segments[source][-1]
        self._unchecked += segment.room - before
        if max(segment.end - segment.begin, log_index.size(str(segment.path))) >= SEGMENT_BYTES:
            self.close(source)

    def _without_doubt(self, source: Source, part: LogPart) -> LogPart:
        """Remove bytes in doubt that a part replaces; return the part without those that stay."""
        zero, last = self._doubted.pop(source, -1), self._last(source)
        if zero < 0 or last is None:
            return part
        if part.offset == zero:
            os.truncate(last.path, zero - last.begin)
            self._refresh(source, last)
            return part
        stored = max(0, last.end - part.offset)  # the host has dropped what is in doubt
        return replace(part, offset=part.offset + stored, content=part.content[stored:])

    def close(self, source: Source) -> None:
        """Compress the open segment of a source, if it has bytes; raises `OSError`."""
        self._doubted.pop(source, None)
        last = self._last(source)
        if last is None or not last.is_open or last.end == last.begin:
            return
        path = path_of(self._directory, source, last.generation, last.begin, last.end)
        closed = last._replace(path=path, is_open=False)
        _compress(last.times, closed.times)
        _compress(last.path, closed.path)
        found = segment_at(closed.path)
        assert found is not None
        self._segments[source][-1] = found[1]
        _remove(last)

    def apply_limits(self) -> int:
        """Remove the oldest segments beyond the bounds; return their number; raises `OSError`."""
        if self._unchecked < self._limits.keep // _EXCESS_PART:
            return 0
        removed = self._remove_excess()
        if not is_within(self._stored(), self._limits):
            for source in list(self._segments):  # open segments become small, and removable
                self.close(source)
            removed += self._remove_excess()
        self._remove_empty()
        self._unchecked = 0
        return removed

    # --- segments ------------------------------------------------------------------------

    def _last(self, source: Source) -> Segment | None:
        segments = self._segments.get(source)
        return segments[-1] if segments else None

    def _stored(self) -> Iterator[tuple[Source, Segment]]:
        for source, segments in self._segments.items():
            for segment in segments:
                yield source, segment

    def _open_at(self, source: Source, offset: int) -> Segment:
        """Return the open segment that continues at an offset, a new one after a gap."""
        last = self._last(source)
        if last is not None and last.is_open:
            if last.end == offset:
                return last
            self.close(source)
        return self._create(source, last.generation if last is not None else 0, offset)

    def _create(self, source: Source, generation: int, begin: int) -> Segment:
        make_private_directory(host_folder(self._directory, source.host))
        path = path_of(self._directory, source, generation, begin, None)
        os.close(open_private(str(path), os.O_WRONLY | os.O_CREAT | os.O_TRUNC))
        segment = Segment(path, generation, begin, begin, 0.0, 0, is_open=True)
        segment.times.unlink(missing_ok=True)
        segments = self._segments.setdefault(source, [])
        if segments and segments[-1].is_open:  # an empty one
            _remove(segments.pop())
        segments.append(segment)
        return segment

    def _refresh(self, source: Source, segment: Segment) -> None:
        found = segment_at(segment.path)
        if found is not None:
            self._segments[source][-1] = found[1]

    def _remove_excess(self) -> int:
        removed = excess(self._stored(), self._limits)
        for source, segment in removed:
            segments = self._segments[source]
            if segments[-1] is segment:
                segments[-1] = self._emptied(source, segment)
            else:
                segments.remove(segment)
                _remove(segment)
        return len(removed)

    def _emptied(self, source: Source, segment: Segment) -> Segment:
        """Replace a closed segment by an empty one at its end; this needs no free room.

        The empty one remembers the position, because the host may still hold the log.
        """
        os.truncate(segment.path, 0)
        segment.times.unlink(missing_ok=True)
        path = path_of(self._directory, source, segment.generation, segment.end, None)
        segment.path.replace(path)
        return Segment(
            path, segment.generation, segment.end, segment.end, segment.time, 0, is_open=True
        )

    def _remove_empty(self) -> None:
        empty = [
            (segments[-1].time, source) for source, segments in self._segments.items()
            if len(segments) == 1 and segments[0].begin == segments[0].end
        ]  # fmt: skip
        for _, source in sorted(empty)[: max(0, len(empty) - _MOST_EMPTY)]:
            _remove(self._segments.pop(source)[0])

    def _remove_remains(self) -> None:
        """Remove files that a crash has left beside the segments."""
        expected = {path for _, segment in self._stored() for path in (segment.path, segment.times)}
        for file in self._directory.glob("hosts/*/*"):
            if file not in expected and is_own_name(file.name):
                file.unlink()


def _first_zero(segment: Segment) -> int:
    """Return the offset of the first zero in the last append of an open segment; -1: none."""
    begin = max(segment.begin, segment.end - LARGEST_LOG_PART)
    with segment.path.open("rb") as file:
        file.seek(begin - segment.begin)
        zero = file.read().find(b"\0")
    return begin + zero if zero >= 0 else -1


def _add_marks(segment: Segment, part: LogPart) -> None:
    """Append the marks of a part to the index, without those that it has."""
    log = str(segment.path)
    with log_index.Index(log) as index:
        last = index.mark(index.count - 1) if index.count else Mark(0.0, segment.begin, 0)
        is_new = not index.count
    end = part.offset + len(part.content)
    for mark in _sane(part.marks, part.offset, end):
        is_later = mark.offset > last.offset
        is_start = mark.offset == last.offset and mark.pid not in {0, last.pid}
        if is_later or is_start or is_new:
            log_index.add(log, mark)
            last, is_new = mark, False


def _sane(marks: Iterable[tuple[float, int, int]], begin: int, end: int) -> Iterator[Mark]:
    """Yield the marks that can be true; the first one behind the part counts as its end."""
    for time, offset, pid in marks:
        if not (log_index.is_possible(time) and 0 <= pid < 1 << 63):
            continue
        if offset > end:
            yield Mark(time, end, 0)
            return
        if offset >= begin:
            yield Mark(time, offset, pid)


def _compress(source: Path, target: Path) -> None:
    """Write a compressed copy of a file; the copy appears when it is complete."""
    try:
        content = source.read_bytes()
    except FileNotFoundError:
        content = b""
    compressed = gzip.compress(content, 6, mtime=0)
    durable.replace_durably(str(target), compressed)


def _remove(segment: Segment) -> None:
    segment.times.unlink(missing_ok=True)
    segment.path.unlink(missing_ok=True)
