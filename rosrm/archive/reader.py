"""Reader of a log archive: the same parts of logs that the slaves would send."""

from __future__ import annotations

import gzip
import zlib
from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from rosrm.archive.layout import Segment, Source, read_segments
from rosrm.errors import Refused
from rosrm.model.rows import LogPart
from rosrm.supervisor import log_index
from rosrm.wording import reason_of

#: Most bytes of a file that are read: a segment is smaller, unless it is damaged.
_MOST: Final = 64 << 20
#: Longest difference (s) between the clocks of a host and of the collector.
_CLOCKS: Final = 86_400.0
_PART: Final = 256 * 1024
_TRIES: Final = 3


@dataclass(frozen=True)
class _Content:
    """Bytes of a segment, with offsets that ascend over the generations of a log.

    Attributes:
        content: the bytes.
        begin: offset of the first one.
        marks: (unix time, offset, pid), ascending.
    """

    content: bytes
    begin: int
    marks: Sequence[tuple[float, int, int]]

    @property
    def end(self) -> int:
        return self.begin + len(self.content)


class LogArchive:
    """Reads a log archive, also while it is written.

    Args:
        directory: of the archive.

    Raises:
        Refused: there is no archive, or it cannot be read.
    """

    def __init__(self, directory: Path) -> None:
        self.directory = directory
        self._loaded: tuple[Path, _Content] | None = None
        self._read_directory()

    def hosts_of(self, process: str) -> Sequence[str]:
        """Return the hosts from which the archive has logs of a process."""
        return sorted({source.host for source in self._sources(process)})

    def numbers(self, host: str, process: str) -> Sequence[int]:
        """Return the instances of a process on a host whose logs the archive has."""
        return sorted(one.number for one in self._sources(process) if one.host == host)

    def collected_until(self, host: str, process: str) -> float:
        """Return the unix time at which the newest bytes of a process on a host were stored."""
        return max(
            (self._segments[one][-1].time for one in self._sources(process) if one.host == host),
            default=0.0,
        )

    def read_log(
        self, host: str, process: str, number: int, offset: int, max_bytes: int = 0, *,
        tail: int = 0, since: float = 0.0,
    ) -> LogPart:  # fmt: skip
        """Return a part of a log, as `MasterClient.read_log` does; raises `Refused`."""
        source = Source(host, process, number)
        for _ in range(_TRIES):
            try:
                return self._part(source, offset, max_bytes or _PART, tail, since)
            except FileNotFoundError:  # closed or removed just now
                self._read_directory()
            except (OSError, EOFError, zlib.error) as error:
                raise Refused(
                    f"{process}: its log in {self.directory} cannot be read: {error}"
                ) from None
        raise Refused(f"{process}: its log in {self.directory} was removed", "unknown")

    # --- segments ------------------------------------------------------------------------

    def _read_directory(self) -> None:
        directory = self.directory
        try:
            if not (directory / "hosts").is_dir():
                raise Refused(
                    f"{directory} is no log archive: `rosrm collect-logs {directory}` makes one",
                    "unknown",
                )
            self._segments = read_segments(directory)
        except OSError as error:
            raise Refused(f"{directory} cannot be read: {reason_of(error)}") from None

    def _sources(self, process: str) -> list[Source]:
        return [
            source for source, segments in self._segments.items()
            if source.process == process and segments[-1].end > 0
        ]  # fmt: skip

    def _part(self, source: Source, offset: int, most: int, tail: int, since: float) -> LogPart:
        segments = _placed(self._segments.get(source, ()))
        if tail:
            offset = self._before_lines(segments, tail)
        elif since:
            offset = self._written_since(segments, since)
        for begin, segment in segments:
            if begin + segment.end - segment.begin > offset:
                part = _cut(source.number, self._content(begin, segment), offset, most)
                if part.content:
                    return part
        return LogPart(source.number, (), b"", offset, offset, True, ())

    def _content(self, begin: int, segment: Segment) -> _Content:
        """Return the bytes of a segment; the last closed one stays in memory."""
        if self._loaded is not None and self._loaded[0] == segment.path:
            return self._loaded[1]
        content = _bytes_of(segment.path)[: segment.end - segment.begin]
        try:
            records = _bytes_of(segment.times)
        except FileNotFoundError:
            records = b""
        shift = begin - segment.begin
        marks = [(time, at + shift, pid) for time, at, pid in log_index.marks_in(records)]
        found = _Content(content, begin, marks)
        if not segment.is_open:
            self._loaded = segment.path, found
        return found

    def _before_lines(self, segments: Sequence[tuple[int, Segment]], lines: int) -> int:
        """Return the offset of the last `lines` lines; an unfinished line counts."""
        at_end = True
        for begin, segment in reversed(segments):
            content = self._content(begin, segment).content
            at = len(content)
            if at_end and at:
                at, at_end = at - content.endswith(b"\n"), False
            while (at := content.rfind(b"\n", 0, at)) >= 0:
                lines -= 1
                if lines == 0:
                    return begin + at + 1
        return 0

    def _written_since(self, segments: Sequence[tuple[int, Segment]], since: float) -> int:
        """Return the offset of output that was written at a time or later."""
        end = 0
        for begin, segment in segments:
            end = begin + segment.end - segment.begin
            if segment.time + _CLOCKS < since:
                continue
            found = self._content(begin, segment)
            late = next((at for at, mark in enumerate(found.marks) if mark[0] >= since), None)
            if late is not None:
                return found.marks[late - 1][1] if late else begin
        return end


def _placed(segments: Sequence[Segment]) -> list[tuple[int, Segment]]:
    """Return each segment with the offset of its first byte; generations follow one another."""
    placed: list[tuple[int, Segment]] = []
    shift = generation = end = 0
    for segment in segments:
        if segment.generation != generation:
            shift, generation = end, segment.generation
        placed.append((segment.begin + shift, segment))
        end = segment.end + shift
    return placed


def _cut(number: int, found: _Content, offset: int, most: int) -> LogPart:
    offset = max(offset, found.begin)
    content = found.content[offset - found.begin :][:most]
    end = offset + len(content)
    first = bisect_left(found.marks, offset, key=lambda mark: mark[1])
    last = bisect_left(found.marks, end, key=lambda mark: mark[1])
    return LogPart(number, (), content, offset, end, True, found.marks[first : last + 1])


def _bytes_of(path: Path) -> bytes:
    with gzip.open(path) if path.suffix == ".gz" else path.open("rb") as file:
        return file.read(_MOST)
