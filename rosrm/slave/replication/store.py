"""Snapshots and replicas on the disk of a host; one thread reads and writes the files."""

from __future__ import annotations

import contextlib
import stat
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from rosrm import clocks
from rosrm.model.values import InstanceId, SnapshotReport
from rosrm.ros.names import token
from rosrm.ros.slave.replication import NotStored
from rosrm.shortage import exists, raise_shortage, status
from rosrm.slave.replication.encryption import decrypted, encrypted
from rosrm.slave.replication.keys import StateKeys
from rosrm.snapshots.format import LARGEST_REPLICA, Damaged, Head, TransferPart, Unreadable
from rosrm.snapshots.reader import COPY, head_of, newest_content, newest_head, snapshot_files
from rosrm.snapshots.writer import CopyWriter, drop_snapshots, drop_torn, write_slot
from rosrm.wording import reason_of

#: Seconds for which a snapshot stays in memory between reads of its parts, and the most bytes of
#: all snapshots in memory before older ones are dropped sooner.
_READ_FOR: Final = 10.0
_MOST_READ: Final = 512 << 20
#: Seconds without a part after which a transfer to this host counts as interrupted, and the most
#: transfers of replicas to this host at a time.
INTERRUPTED: Final = 30.0
MOST_INCOMING: Final = 16
#: Most processes of other hosts with a replica here, and the bytes that even a small one counts.
MOST_REPLICAS: Final = 1000
_LEAST_COUNTED: Final = 4096
#: A replica whose instance number is greater by more than this than that of a replica which is
#: offered now is doubtful: no cluster starts as many instances between two of one process. If its
#: sender does not refresh it for so many seconds, the offered one replaces it.
FAR_AHEAD: Final = 1_000_000
DOUBTFUL_FOR: Final = 60.0


@dataclass(slots=True)
class _Incoming:
    """Transfer of a snapshot to this host.

    Attributes:
        bounded: of another host's process; False: fetched for a start.
        until: time at which the transfer is given up.
    """

    age: tuple[int, int]
    total: int
    bounded: bool
    writer: CopyWriter
    until: float
    digest: int = 0

    def is_followed_by(self, part: TransferPart, *, bounded: bool) -> bool:
        """Return True if a part is the next one of this transfer."""
        same = (part.age, part.total, bounded) == (self.age, self.total, self.bounded)
        fits = 0 < len(part.data) <= self.total - self.writer.size
        return same and fits and part.offset == self.writer.size


@dataclass(slots=True)
class _BeingRead:
    head: Head
    content: bytes
    digest: int
    until: float


class SnapshotStore:
    """Snapshot files of all processes below one directory.

    While a process has a key here, no snapshot of it leaves this host without encryption, and no
    replica of it is stored that was not encrypted with this key.

    Args:
        root: the directory, created with the first snapshot.
        max_bytes: most bytes of all replicas of other hosts' processes.
        clock: monotonic seconds.

    Attributes:
        keys: of the processes that have snapshots here.
    """

    def __init__(
        self, root: Path, max_bytes: int, clock: Callable[[], float] = clocks.boot_time
    ) -> None:
        self._root = root
        self._max_bytes = max_bytes
        self._clock = clock
        self._began = clock()
        self._incoming: dict[str, _Incoming] = {}
        self._refreshed: dict[str, float] = {}
        self._being_read: dict[str, _BeingRead] = {}
        self.keys = StateKeys(self.directory)

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
        return exists(self._root)

    def drop_torn(self) -> list[Path]:
        """Delete the slots that a loss of power has torn; return their paths.

        Raises:
            OSError: the files cannot be read or deleted now.
        """
        return [path for directory in self._directories() for path in drop_torn(directory)]

    def scan(self) -> tuple[SnapshotReport, ...]:
        """Return the newest snapshot of each process.

        Raises:
            OSError: the files cannot be read now.
        """
        heads = []
        for directory in self._directories():
            head = newest_head(directory)
            if head is not None:
                self._rename(directory, head.process)
                heads.append(head)
        return tuple(
            SnapshotReport(InstanceId(head.process, head.instance), head.sequence, head.size)
            for head in heads
        )

    def _directories(self) -> list[Path]:
        """Return the directories of all processes."""
        try:
            paths = sorted(self._root.iterdir())
        except FileNotFoundError:
            return []
        found = []
        for path in paths:
            try:
                if not exists(path):  # an old name of a directory whose snapshots were dropped
                    path.unlink(missing_ok=True)
                one = status(path, follow_symlinks=False)
            except OSError as error:
                raise_shortage(error)  # but a damaged directory hides no other
                continue
            if one is not None and stat.S_ISDIR(one.st_mode):
                found.append(path)
        return found

    def _rename(self, directory: Path, process: str) -> None:
        """Rename a directory to which an earlier release gave another name, and leave a link.

        The supervisor restarts an instance with the path that it had at its first start.
        """
        right = self.directory(process)
        if directory != right and not exists(right):
            with contextlib.suppress(OSError):
                directory.rename(right)
                directory.symlink_to(right.name)

    def newer_than(self, process: str, age: tuple[int, int]) -> tuple[Head, bytes, int] | None:
        """Return the newest complete snapshot as other hosts get it, with its CRC-32.

        None: none is newer than `age`.
        """
        head = newest_head(self.directory(process))
        if head is None or head.age <= age:
            return None
        found = newest_content(self.directory(process))
        if found is None or found[0].age <= age:
            return None
        head, content = found
        key = self.keys.of(process)
        if key and not head.encrypted:
            content = encrypted(key, head, content)
        return head, content, zlib.crc32(content)

    def open_replica(self, process: str, up_to: int) -> str:
        """Make the replica on this host readable for a node that is about to start.

        An encrypted replica that is newer than the node's own snapshots replaces the older one of
        these. A replica that is not allowed is deleted.

        Args:
            process: name of the process.
            up_to: number of the instance that starts.

        Returns:
            Why the replica is not used, as a sentence; "": it can be read, or is not needed.

        Raises:
            OSError: the replica cannot be read or written now; it stays.
        """
        directory = self.directory(process)
        path, key = directory / COPY, self.keys.of(process)
        try:
            copy = head_of(path)
        except (FileNotFoundError, Damaged):
            return ""
        if not (key or copy.encrypted):
            return ""
        own = self.newest_readable(process)
        is_older = own is not None and copy.age <= own.age
        if copy.encrypted and (copy.instance > up_to or is_older):
            return ""
        try:
            write_slot(directory, self._decrypted(key, path))
        except Unreadable as fault:
            raise fault.error from None
        except Damaged as fault:
            path.unlink(missing_ok=True)
            return str(fault)
        path.unlink(missing_ok=True)
        return ""

    def newest_readable(self, process: str) -> Head | None:
        """Return the header of the newest snapshot that a node can read; None: there is none."""
        heads = (head for _, head in snapshot_files(self.directory(process)))
        return next((head for head in heads if not head.encrypted), None)

    def _decrypted(self, key: bytes, path: Path) -> bytes:
        if not key:
            raise Damaged("it is encrypted, and this process has no key")
        return decrypted(key, path)

    def drop(self, process: str, up_to: int) -> None:
        """Delete the snapshots of instances up to a number."""
        drop_snapshots(self.directory(process), up_to)
        self.keys.drop(process, up_to)
        self._refreshed.pop(process, None)

    def end_interrupted(self, now: float) -> None:
        """Give up the transfers whose other side is silent; they take disk space and memory."""
        for process in [name for name, one in self._incoming.items() if now >= one.until]:
            self._abandon(process)
        for process in [name for name, one in self._being_read.items() if now >= one.until]:
            del self._being_read[process]

    # --- incoming snapshots --------------------------------------------------------------

    def take(self, part: TransferPart, *, bounded: bool) -> NotStored | None:
        """Write a part of a snapshot; return why it was refused, or None. The last completes it.

        With `bounded` it is of another host's process, and `max_bytes` limits all such replicas.
        """
        try:
            return self._take(part, bounded=bounded)
        except OSError as error:
            self._abandon(part.process)
            return NotStored("full", f"it cannot be written: {reason_of(error)}")
        except Damaged as fault:
            return NotStored("damaged", str(fault))

    def _take(self, part: TransferPart, *, bounded: bool) -> NotStored | None:
        self.end_interrupted(self._clock())
        if part.offset == 0:
            refusal = self._refusal(part, bounded=bounded)
            if refusal is not None:
                return refusal
            self._begin(part, bounded=bounded)
        coming = self._incoming.get(part.process)
        if coming is None or not coming.is_followed_by(part, bounded=bounded):
            return NotStored("order", "it does not follow the part before it: send all parts again")
        coming.until = self._clock() + INTERRUPTED
        coming.writer.append(part.data)
        coming.digest = zlib.crc32(part.data, coming.digest)
        if coming.writer.size == coming.total:
            self._finish(part, coming)
        return None

    def _refusal(self, part: TransferPart, *, bounded: bool) -> NotStored | None:
        """Return why no transfer of this snapshot may begin; None: it may."""
        newest = self._as_new_as(part, bounded=bounded)
        if newest is not None:
            return NotStored(
                "newer", f"{newest.process}#{newest.instance}, cycle {newest.sequence} is here"
            )
        if part.total > LARGEST_REPLICA:
            return NotStored(
                "full", f"it has {part.total} bytes; at most {LARGEST_REPLICA} are kept"
            )
        obstacle = self._obstacle(part) if bounded else ""
        return NotStored("full", obstacle) if obstacle else None

    def _as_new_as(self, part: TransferPart, *, bounded: bool) -> Head | None:
        """Return a snapshot on this host that is at least as new as a part; None: there is none.

        Ignores snapshots of doubtful age. For a start, which is not `bounded`, only snapshots that
        the node can read count.
        """
        refreshed = self._refreshed.get(part.process, self._began)
        for path, head in snapshot_files(self.directory(part.process)):
            if head.encrypted and not bounded:
                continue
            if head.age < part.age:
                return None
            far = path.name == COPY and head.instance - part.number > FAR_AHEAD
            if not far or self._clock() - refreshed < DOUBTFUL_FOR:
                return head
        return None

    def _obstacle(self, part: TransferPart) -> str:
        """Return why a replica of another host's process has no room here; "": there is room."""
        others = [one for name, one in self._incoming.items() if name != part.process]
        own = self._incoming.get(part.process)
        if own is not None and not own.bounded:
            return "it is being fetched for a start"
        if len(others) >= MOST_INCOMING:
            return f"{MOST_INCOMING} others are being received"
        sizes = [max(one.total, _LEAST_COUNTED) for one in others]
        sizes += self._sizes_of_replicas(but=self.directory(part.process))
        if len(sizes) >= MOST_REPLICAS:
            return f"replicas of {MOST_REPLICAS} processes are here"
        if sum(sizes) + max(part.total, _LEAST_COUNTED) > self._max_bytes:
            return f"with it there were more than {self._max_bytes} bytes (keep.max_bytes)"
        return ""

    def _sizes_of_replicas(self, but: Path) -> list[int]:
        sizes = []
        for directory in self._directories():
            if directory != but:
                with contextlib.suppress(FileNotFoundError):
                    sizes.append(max((directory / COPY).stat().st_size, _LEAST_COUNTED))
        return sizes

    def _begin(self, part: TransferPart, *, bounded: bool) -> None:
        self._abandon(part.process)
        self.make()
        until = self._clock() + INTERRUPTED
        writer = CopyWriter(self.directory(part.process))
        self._incoming[part.process] = _Incoming(part.age, part.total, bounded, writer, until)

    def _finish(self, part: TransferPart, coming: _Incoming) -> None:
        del self._incoming[part.process]
        try:
            self._check_and_store(part, coming)
        except BaseException:  # also without memory its file is closed
            coming.writer.abandon()
            raise
        self._refreshed[part.process] = self._clock()

    def _check_and_store(self, part: TransferPart, coming: _Incoming) -> None:
        if coming.digest != part.digest:
            raise Damaged("the content does not match its checksum")
        head = coming.writer.check(part.process, part.age)
        key = self.keys.of(part.process)
        state = b""
        if key or (head.encrypted and not coming.bounded):
            state = self._decrypted(key, coming.writer.path)
        if state and not coming.bounded:
            write_slot(self.directory(part.process), state)
            coming.writer.abandon()
        else:
            coming.writer.finish()

    def _abandon(self, process: str) -> None:
        coming = self._incoming.pop(process, None)
        if coming is not None:
            coming.writer.abandon()

    # --- outgoing snapshots --------------------------------------------------------------

    def read(
        self, process: str, age: tuple[int, int], offset: int, size: int
    ) -> TransferPart | None:
        """Return a part of a snapshot; None: this host does not hold the snapshot (any more).

        The age (0, 0) requests the newest snapshot.
        """
        now = self._clock()
        one = self._being_read.pop(process, None)
        if one is None or one.head.age != age:
            found = self.newer_than(process, (0, 0))
            if found is None or age not in {(0, 0), found[0].age}:
                return None
            one = _BeingRead(*found, until=now)
        one.until = now + _READ_FOR
        head, data = one.head, one.content[offset : offset + size]
        if offset + len(data) < len(one.content):
            self._drop_oldest_read(_MOST_READ - len(one.content))
            self._being_read[process] = one
        return TransferPart(
            process, head.instance, head.sequence, offset, len(one.content), one.digest, data
        )

    def _drop_oldest_read(self, room: int) -> None:
        """Drop the snapshots in memory that were read longest ago until the others fit."""
        while self._being_read and sum(len(o.content) for o in self._being_read.values()) > room:
            del self._being_read[next(iter(self._being_read))]
