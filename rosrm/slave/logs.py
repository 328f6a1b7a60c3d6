"""Reader of instance logs across rotated files, for `rosrm logs`."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final, NamedTuple

from rosrm import clocks
from rosrm.errors import Refused
from rosrm.model.rows import LARGEST_LOG_PART, LogPart
from rosrm.model.values import InstanceId
from rosrm.ros.slave.services import LogQuery
from rosrm.shortage import exists
from rosrm.supervisor import log_index, paths
from rosrm.supervisor.client import log_path
from rosrm.wording import reason_of

#: Most marks in one answer; an answer with more marks is shortened.
_MOST_MARKS: Final = 4096
#: Bytes of a block in the search for line ends.
_BLOCK: Final = 1 << 16
#: Attempts to read a log that is rotated during the read.
_TRIES: Final = 5


class _Segment(NamedTuple):
    """File of a log, with the offsets of its first byte and its end in the instance's output."""

    path: Path
    begin: int
    end: int


def read_log(state_directory: Path, query: LogQuery, *, ended: bool, pid: int = 0) -> LogPart:
    """Read a part of an instance's output; raises `Refused` if this host has no log of it.

    Args:
        state_directory: of the supervisor.
        query: number 0 is that of the newest instance with a log here.
        ended: the instance has ended.
        pid: of its process; 0: unknown.
    """
    if not query.number:
        newest = newest_instance(state_directory, query.process)
        query = replace(query, number=newest.number)
    instance = InstanceId(query.process, query.number)
    path = log_path(state_directory, instance)
    missing = Refused(f"this host has no log of {instance} (any more)", "unknown")
    if query.number < query.first:
        raise missing  # that instance belonged to another owner of the name
    logged = _logged(state_directory, query.process)
    numbers = tuple(number for number in logged if number >= query.first)
    for _ in range(_TRIES):
        try:
            before = log_index.base(str(path))
            part = _read(path, _segments(path), query, numbers, ended=ended, pid=pid)
            after = log_index.base(str(path))
        except FileNotFoundError:
            if not exists(path):
                break
            continue  # rotated during the read
        except OSError as error:
            raise Refused(f"the log of {instance} cannot be read: {reason_of(error)}") from None
        if after == before:
            return part
    raise missing


def newest_instance(state_directory: Path, process: str) -> InstanceId:
    """Return the newest instance of a process that has a log here; raises `Refused`."""
    numbers = _logged(state_directory, process)
    if not numbers:
        raise Refused(f"this host has no log of {process}", "unknown")
    return InstanceId(process, numbers[-1])


def nothing_yet(query: LogQuery) -> LogPart:
    """Return an empty answer for an instance that is starting, whose file does not exist yet."""
    return LogPart(query.number, (), b"", query.offset, query.offset, False, ())


def _logged(state_directory: Path, process: str) -> list[int]:
    """Return the numbers of the instances of a process that have a log, ascending."""
    wanted = paths.safe_name(process)
    folder = Path(paths.log_folder(str(state_directory)))
    try:
        found = [paths.log_number(path.name) for path in folder.iterdir()]
    except FileNotFoundError:
        return []
    return sorted(log[1] for log in found if log is not None and log[0] == wanted)


def _segments(path: Path) -> list[_Segment]:
    """Return the files of a log, the oldest first."""
    files, number = [path], 1
    while exists(older := path.with_name(f"{path.name}.{number}")):
        files.append(older)
        number += 1
    segments: list[_Segment] = []
    for file in reversed(files):
        size = file.stat().st_size
        begin = log_index.base(str(file))
        if begin is None:  # written by a version without indices
            begin = segments[-1].end if segments else 0
        segments.append(_Segment(file, begin, begin + size))
    return segments


def _read(
    path: Path, segments: Sequence[_Segment], query: LogQuery, numbers: Sequence[int], *,
    ended: bool, pid: int,
) -> LogPart:  # fmt: skip
    last = segments[-1].end
    offset = min(_start(segments, query), last)
    found = next((one for one in segments if one.end > offset), segments[-1])
    if offset < found.begin:
        offset = _whole_line(found)
    with found.path.open("rb") as log:
        log.seek(offset - found.begin)
        content = log.read(min(query.max_bytes or LARGEST_LOG_PART, LARGEST_LOG_PART))
    marks, end = _marks(found, offset, offset + len(content), now=found.path == path, pid=pid)
    content = content[: end - offset]
    return LogPart(query.number, numbers, content, offset, end, ended and end >= last, marks)


def _start(segments: Sequence[_Segment], query: LogQuery) -> int:
    """Return the offset at which a query begins."""
    if query.tail:
        return _before_lines(segments, query.tail)
    if query.since:
        return _written_since(segments, query.since)
    return query.offset


def _whole_line(segment: _Segment) -> int:
    """Return the offset of the first whole line of a file, if earlier output was dropped.

    A file with a single line keeps that line, even if it is incomplete.
    """
    with log_index.Index(str(segment.path)) as index:
        first = index.marks(0, 2)  # marks of the file, and of a program that starts there
    if segment.begin == 0 or any(mark.pid and mark.offset == segment.begin for mark in first):
        return segment.begin
    with segment.path.open("rb") as log:
        end = log.read(_BLOCK).find(b"\n") + 1
    return segment.begin + (end if segment.begin + end < segment.end else 0)


def _before_lines(segments: Sequence[_Segment], lines: int) -> int:
    """Return the offset of the last `lines` lines; an unfinished line counts."""
    wanted, at_end = lines, True
    for segment in reversed(segments):
        with segment.path.open("rb") as log:
            end = segment.end - segment.begin
            while end > 0:
                begin = max(0, end - _BLOCK)
                block = os.pread(log.fileno(), end - begin, begin)
                wanted += at_end and block.endswith(b"\n")
                at_end = False
                at = len(block)
                while (at := block.rfind(b"\n", 0, at)) >= 0:
                    wanted -= 1
                    if wanted == 0:
                        return segment.begin + begin + at + 1
                end = begin
    return _whole_line(segments[0])


def _written_since(segments: Sequence[_Segment], since: float) -> int:
    """Return the offset of output that was written at a time or later."""
    for segment in segments:
        with log_index.Index(str(segment.path)) as index:
            late = index.find(lambda mark: mark.time >= since)
            if 0 < late < index.count:
                return index.mark(late - 1).offset
            if late < index.count:
                return _whole_line(segment) if segment is segments[0] else segment.begin
    # The newest bytes of a growing log may be later than its last mark.
    with log_index.Index(str(segments[-1].path)) as index:
        return index.mark(index.count - 1).offset if index.count else segments[-1].begin


def _marks(
    segment: _Segment, begin: int, end: int, *, now: bool, pid: int
) -> tuple[list[tuple[float, int, int]], int]:
    """Return the marks of a part, including one after its end, and the end of the part.

    With `now` the file is still written, and bytes without a mark count as written now. The
    supervisor creates the index shortly after the first output. Until then, the time of the newest
    output counts as the time of the start.
    """
    with log_index.Index(str(segment.path)) as index:
        first = index.find(lambda mark: mark.offset >= begin)
        last = index.find(lambda mark: mark.offset >= end)
        found = index.marks(first, min(last + 1 - first, _MOST_MARKS))
        if pid and not index.count and begin == 0:
            found = [log_index.Mark(segment.path.stat().st_mtime, 0, pid)]
    if len(found) == _MOST_MARKS:
        return list(found), min(end, found[-1].offset)
    if now and (not found or found[-1].offset < end):
        found.append(log_index.Mark(clocks.wall_time(), end, 0))
    return list(found), end
