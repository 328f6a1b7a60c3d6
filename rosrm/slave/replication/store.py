"""The kept states of a host, on its disk. What reads and writes files runs in one thread."""

from __future__ import annotations

import contextlib
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from rosrm import snapshots
from rosrm.model.values import InstanceId, KeptState
from rosrm.ros.names import token
from rosrm.snapshots import Part

#: Seconds for which a state that is being read stays in memory.
_READ_FOR: Final = 10.0


@dataclass(slots=True)
class _Coming:
    age: tuple[int, int]
    total: int
    writer: snapshots.CopyWriter
    digest: int = 0


@dataclass(slots=True)
class _BeingRead:
    head: snapshots.Head
    content: bytes
    digest: int
    until: float


class KeptStore:
    """Files of all processes below one directory.

    Args:
        root: it is made when the first state is kept.
        max_bytes: of states of other hosts' processes, all together.
    """

    def __init__(self, root: Path, max_bytes: int) -> None:
        self._root = root
        self._max_bytes = max_bytes
        self._coming: dict[str, _Coming] = {}
        self._being_read: dict[str, _BeingRead] = {}

    def directory(self, process: str) -> Path:
        """Where the state of a process is kept."""
        return self._root / token(process)

    def make(self) -> None:
        """Make the directory of all states, for the owner alone; that it fails is said later."""
        with contextlib.suppress(OSError):
            self._root.mkdir(mode=0o700, parents=True, exist_ok=True)

    def is_used(self) -> bool:
        """Whether anything was ever kept here."""
        return self._root.exists()

    def scan(self) -> tuple[KeptState, ...]:
        """The newest state of each process."""
        try:
            directories = sorted(path for path in self._root.iterdir() if path.is_dir())
        except OSError:
            return ()
        heads = [head for one in directories if (head := snapshots.newest_head(one)) is not None]
        return tuple(
            KeptState(InstanceId(head.process, head.instance), head.sequence, head.size)
            for head in heads
        )

    def newer_than(
        self, process: str, age: tuple[int, int]
    ) -> tuple[snapshots.Head, bytes, int] | None:
        """The newest whole state with its CRC-32; None: there is none that is newer."""
        head = snapshots.newest_head(self.directory(process))
        if head is None or head.age <= age:
            return None
        found = snapshots.newest_content(self.directory(process))
        if found is None or found[0].age <= age:
            return None
        return (*found, zlib.crc32(found[1]))

    def drop(self, process: str, up_to: int) -> None:
        """Delete the states of instances up to a number."""
        snapshots.drop(self.directory(process), up_to)

    # --- what comes ----------------------------------------------------------------------

    def take(self, part: Part, *, bounded: bool) -> tuple[str, str]:
        """Take a part of a state; with the last one it is kept.

        Args:
            bounded: it is of another host's process, for which there is so much room and no more.

        Returns:
            Why it was not taken: a code and a message; ("", ""): it was.
        """
        if part.offset == 0:
            refusal = self._begin(part, bounded=bounded)
            if refusal[0]:
                return refusal
        coming = self._coming.get(part.process)
        if coming is None or coming.age != part.age or coming.writer.size != part.offset:
            return "order", "it does not follow the part before it: send all parts again"
        try:
            coming.writer.append(part.data)
            coming.digest = zlib.crc32(part.data, coming.digest)
            if part.is_last:
                self._finish(part, coming)
        except OSError as error:
            self._abandon(part.process)
            return "full", f"it cannot be written: {error.strerror}"
        except snapshots.Damaged as fault:
            return "damaged", str(fault)
        return "", ""

    def _begin(self, part: Part, *, bounded: bool) -> tuple[str, str]:
        self._abandon(part.process)
        directory = self.directory(part.process)
        newest = snapshots.newest_head(directory)
        if newest is not None and newest.age >= part.age:
            return "newer", f"{newest.process}#{newest.instance}, cycle {newest.sequence} is here"
        if part.total > snapshots.LARGEST:
            return "full", f"it has {part.total} bytes; at most {snapshots.LARGEST} are kept"
        if bounded and not self._has_room(part):
            return "full", f"with it there were more than {self._max_bytes} bytes (keep.max_bytes)"
        self.make()
        try:
            writer = snapshots.CopyWriter(directory)
        except OSError as error:
            return "full", f"it cannot be written: {error.strerror}"
        self._coming[part.process] = _Coming(part.age, part.total, writer)
        return "", ""

    def _has_room(self, part: Part) -> bool:
        """Whether it fits beside the copies of other processes, and those that are coming."""
        own = self.directory(part.process)
        used = sum(one.total for one in self._coming.values())
        with contextlib.suppress(OSError):
            for directory in self._root.iterdir():
                if directory != own:
                    with contextlib.suppress(OSError):
                        used += (directory / snapshots.COPY).stat().st_size
        return used + part.total <= self._max_bytes

    def _finish(self, part: Part, coming: _Coming) -> None:
        del self._coming[part.process]
        if coming.digest != part.digest:
            coming.writer.abandon()
            raise snapshots.Damaged("what came does not match its checksum")
        head = coming.writer.finish()
        if head.process != part.process:
            snapshots.drop(self.directory(part.process), head.instance)
            raise snapshots.Damaged(f"it is a state of {head.process!r}")

    def _abandon(self, process: str) -> None:
        coming = self._coming.pop(process, None)
        if coming is not None:
            coming.writer.abandon()

    # --- what is read --------------------------------------------------------------------

    def read(
        self, process: str, age: tuple[int, int], offset: int, size: int, now: float
    ) -> Part | None:
        """A part of a state; None: it is not here (any more).

        Args:
            age: of the state that is being read; (0, 0): the newest.
        """
        for name in [name for name, one in self._being_read.items() if now >= one.until]:
            del self._being_read[name]
        one = self._being_read.get(process)
        if one is None or one.head.age != age:
            found = self.newer_than(process, (0, 0))
            if found is None or age not in {(0, 0), found[0].age}:
                return None
            one = self._being_read[process] = _BeingRead(*found, until=now + _READ_FOR)
        one.until = now + _READ_FOR
        head, data = one.head, one.content[offset : offset + size]
        if offset + len(data) >= len(one.content):
            self._being_read.pop(process, None)
        return Part(
            process, head.instance, head.sequence, offset, len(one.content), one.digest, data
        )
