"""Snapshots and replicas on the disk of a host; one thread reads and writes the files."""

from __future__ import annotations

import contextlib
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from rosrm.model.values import InstanceId, SnapshotReport
from rosrm.ros.names import token
from rosrm.ros.slave.replication import NotStored
from rosrm.snapshots.format import LARGEST, Damaged, Head, TransferPart
from rosrm.snapshots.reader import COPY, newest_content, newest_head
from rosrm.snapshots.writer import CopyWriter, drop_snapshots

#: Seconds for which a snapshot stays in memory between reads of its parts.
_READ_FOR: Final = 10.0
#: Seconds without a part after which a transfer to this host counts as interrupted.
_INTERRUPTED: Final = 30.0


@dataclass(slots=True)
class _Incoming:
    age: tuple[int, int]
    total: int
    writer: CopyWriter
    digest: int = 0
    until: float = 0.0


@dataclass(slots=True)
class _BeingRead:
    head: Head
    content: bytes
    digest: int
    until: float


class SnapshotStore:
    """Snapshot files of all processes below one directory.

    Args:
        root: the directory, created with the first snapshot.
        max_bytes: most bytes of all replicas of other hosts' processes.
    """

    def __init__(self, root: Path, max_bytes: int) -> None:
        self._root = root
        self._max_bytes = max_bytes
        self._incoming: dict[str, _Incoming] = {}
        self._being_read: dict[str, _BeingRead] = {}

    def directory(self, process: str) -> Path:
        """Return the directory of the snapshots of a process."""
        return self._root / token(process)

    def make(self) -> None:
        """Create the directory of all snapshots for the owner alone; ignore a failure.

        Later writes report the failure.
        """
        with contextlib.suppress(OSError):
            self._root.mkdir(mode=0o700, parents=True, exist_ok=True)

    def is_used(self) -> bool:
        """Return True if this host ever stored a snapshot."""
        return self._root.exists()

    def scan(self) -> tuple[SnapshotReport, ...]:
        """Return the newest snapshot of each process."""
        try:
            directories = sorted(path for path in self._root.iterdir() if path.is_dir())
        except OSError:
            return ()
        heads = [head for one in directories if (head := newest_head(one)) is not None]
        return tuple(
            SnapshotReport(InstanceId(head.process, head.instance), head.sequence, head.size)
            for head in heads
        )

    def newer_than(self, process: str, age: tuple[int, int]) -> tuple[Head, bytes, int] | None:
        """Return the newest complete snapshot with its CRC-32; None if none is newer than `age`."""
        head = newest_head(self.directory(process))
        if head is None or head.age <= age:
            return None
        found = newest_content(self.directory(process))
        if found is None or found[0].age <= age:
            return None
        return (*found, zlib.crc32(found[1]))

    def drop(self, process: str, up_to: int) -> None:
        """Delete the snapshots of instances up to a number."""
        drop_snapshots(self.directory(process), up_to)

    # --- incoming snapshots --------------------------------------------------------------

    def take(self, part: TransferPart, now: float, *, bounded: bool) -> NotStored | None:
        """Write a part of a snapshot; return why it was refused, or None. The last completes it.

        With `bounded` it is of another host's process, and `max_bytes` limits all such replicas.
        """
        if part.offset == 0:
            refusal = self._begin(part, bounded=bounded)
            if refusal is not None:
                return refusal
        coming = self._incoming.get(part.process)
        if coming is None or coming.age != part.age or coming.writer.size != part.offset:
            return NotStored("order", "it does not follow the part before it: send all parts again")
        coming.until = now + _INTERRUPTED
        try:
            coming.writer.append(part.data)
            coming.digest = zlib.crc32(part.data, coming.digest)
            if part.is_last:
                self._finish(part, coming)
        except OSError as error:
            self._abandon(part.process)
            return NotStored("full", f"it cannot be written: {error.strerror}")
        except Damaged as fault:
            return NotStored("damaged", str(fault))
        return None

    def _begin(self, part: TransferPart, *, bounded: bool) -> NotStored | None:
        self._abandon(part.process)
        directory = self.directory(part.process)
        newest = newest_head(directory)
        if newest is not None and newest.age >= part.age:
            return NotStored(
                "newer", f"{newest.process}#{newest.instance}, cycle {newest.sequence} is here"
            )
        if part.total > LARGEST:
            return NotStored("full", f"it has {part.total} bytes; at most {LARGEST} are kept")
        if bounded and not self._has_room(part):
            return NotStored(
                "full", f"with it there were more than {self._max_bytes} bytes (keep.max_bytes)"
            )
        self.make()
        try:
            writer = CopyWriter(directory)
        except OSError as error:
            return NotStored("full", f"it cannot be written: {error.strerror}")
        self._incoming[part.process] = _Incoming(part.age, part.total, writer)
        return None

    def _has_room(self, part: TransferPart) -> bool:
        """Return True if a snapshot fits beside other replicas and running transfers."""
        own = self.directory(part.process)
        used = sum(one.total for one in self._incoming.values())
        with contextlib.suppress(OSError):
            for directory in self._root.iterdir():
                if directory != own:
                    with contextlib.suppress(OSError):
                        used += (directory / COPY).stat().st_size
        return used + part.total <= self._max_bytes

    def _finish(self, part: TransferPart, coming: _Incoming) -> None:
        del self._incoming[part.process]
        if coming.digest != part.digest:
            coming.writer.abandon()
            raise Damaged("what came does not match its checksum")
        head = coming.writer.finish()
        if head.process != part.process:
            drop_snapshots(self.directory(part.process), head.instance)
            raise Damaged(f"it is a state of {head.process!r}")

    def abandon_interrupted(self, now: float) -> None:
        """Delete the unfinished replicas whose senders send no more; they take room."""
        for process in [name for name, one in self._incoming.items() if now >= one.until]:
            self._abandon(process)

    def _abandon(self, process: str) -> None:
        coming = self._incoming.pop(process, None)
        if coming is not None:
            coming.writer.abandon()

    # --- outgoing snapshots --------------------------------------------------------------

    def read(
        self, process: str, age: tuple[int, int], offset: int, size: int, now: float
    ) -> TransferPart | None:
        """Return a part of a snapshot; None: this host does not hold the snapshot (any more).

        The age (0, 0) requests the newest snapshot.
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
        return TransferPart(
            process, head.instance, head.sequence, offset, len(one.content), one.digest, data
        )
