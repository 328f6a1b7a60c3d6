"""Files of a log archive.

Each file holds consecutive bytes that an instance wrote::

    hosts/HOST/PROCESS.NUMBER.GENERATION.BEGIN.log             open: more bytes are appended
    hosts/HOST/PROCESS.NUMBER.GENERATION.BEGIN.log.times       its time index (`log_index`)
    hosts/HOST/PROCESS.NUMBER.GENERATION.BEGIN-END.log.gz      closed
    hosts/HOST/PROCESS.NUMBER.GENERATION.BEGIN-END.times.gz    its time index

BEGIN and END are offsets from the first byte that the instance wrote. So names and sizes alone say
which bytes the archive has, and no other file could disagree with them. The generation increases
when a host holds another log under the same number, because its state directory was removed.
"""

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import Final, NamedTuple
from urllib.parse import unquote_to_bytes

from rosrm.supervisor import paths

_NAME: Final = re.compile(
    r"(.+)\.([0-9]{1,20})\.([0-9]{1,9})\.([0-9]{1,20})(?:-([0-9]{1,20})\.log\.gz|\.log)"
)
_OWN_NAME: Final = re.compile(r".+\.[0-9]+\.[0-9]+\.[0-9]+(-[0-9]+)?\.(log|times)(\.[a-z.]+)?")
#: Bytes that a file takes on the disk at least; each segment has two.
_BLOCK: Final = 4096


class Source(NamedTuple):
    """An instance of a process on a host, whose log is in the archive."""

    host: str
    process: str
    number: int


class Segment(NamedTuple):
    """A file of the archive.

    Attributes:
        path: of the content.
        generation: of the log.
        begin: offset of the first byte.
        end: offset after the last byte.
        time: unix time of the last change, by the clock of the collector.
        room: bytes on the disk, with the index.
        is_open: more bytes may be appended; otherwise it is compressed.
    """

    path: Path
    generation: int
    begin: int
    end: int
    time: float
    room: int
    is_open: bool

    @property
    def times(self) -> Path:
        """Return the path of the time index."""
        name = self.path.name
        return self.path.with_name(
            f"{name}.times" if self.is_open else f"{name.removesuffix('.log.gz')}.times.gz"
        )

    @property
    def position(self) -> tuple[int, int]:
        """Return the place of the segment in the log of its instance."""
        return self.generation, self.begin


Segments = dict[Source, list[Segment]]


def host_folder(directory: Path, host: str) -> Path:
    """Return the folder of a host; its name cannot lead to another place."""
    return directory / "hosts" / paths.safe_name(host)


def is_own_name(name: str) -> bool:
    """Return True if a file of this name belongs to a segment, or is left over from one."""
    return _OWN_NAME.fullmatch(name) is not None


def path_of(directory: Path, source: Source, generation: int, begin: int, end: int | None) -> Path:
    """Return the path of a segment; `end` None: it is open."""
    name = f"{paths.safe_name(source.process)}.{source.number}.{generation}.{begin}"
    last = ".log" if end is None else f"-{end}.log.gz"
    return host_folder(directory, source.host) / f"{name}{last}"


def segment_at(path: Path) -> tuple[Source, Segment] | None:
    """Return the segment in a file, and its source; None: the file is no segment.

    Raises:
        OSError: the file cannot be read.
    """
    found = _NAME.fullmatch(path.name)
    if found is None:
        return None
    source = Source(_name_of(path.parent.name), _name_of(found[1]), int(found[2]))
    state = path.stat(follow_symlinks=False)
    begin, is_open = int(found[4]), found[5] is None
    end = begin + state.st_size if is_open else int(found[5])
    segment = Segment(path, int(found[3]), begin, end, state.st_mtime, 0, is_open)
    try:
        beside = segment.times.stat(follow_symlinks=False).st_size
    except FileNotFoundError:
        beside = 0
    return source, segment._replace(room=_on_disk(state.st_size) + _on_disk(beside))


def read_segments(directory: Path) -> Segments:
    """Return the segments of each source in their order.

    If a closed and an open segment begin at the same offset, return the closed one: a crash can
    leave both, and the closed one is complete.

    Raises:
        OSError: the directory cannot be read.
    """
    found: Segments = {}
    for file in sorted(directory.glob("hosts/*/*.log*")):
        try:
            one = segment_at(file)
        except FileNotFoundError:  # removed or closed just now
            continue
        if one is not None:
            found.setdefault(one[0], []).append(one[1])
    return {source: _in_order(segments) for source, segments in found.items()}


def _in_order(segments: list[Segment]) -> list[Segment]:
    chosen: dict[tuple[int, int], Segment] = {}
    for segment in segments:
        other = chosen.get(segment.position)
        if other is None or other.is_open:
            chosen[segment.position] = segment
    return [chosen[position] for position in sorted(chosen)]


def _name_of(file_name: str) -> str:
    """Return the name that `paths.safe_name` has made safe."""
    return os.fsdecode(unquote_to_bytes(file_name))


def _on_disk(size: int) -> int:
    return -(-size // _BLOCK) * _BLOCK
