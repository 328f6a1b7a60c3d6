"""Writers of snapshots (a node's two slots, a slave's replica), and their deletion."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from rosrm.runtime import durable
from rosrm.shortage import status
from rosrm.snapshots.format import (
    Block,
    Damaged,
    Head,
    Unreadable,
    checked,
    decoded_head,
    encoded_head,
)
from rosrm.snapshots.reader import (
    COPY,
    HEAD_ROOM,
    OPEN,
    SLOTS,
    checked_replica,
    content_of,
    head_of,
    paths_of,
    snapshot_files,
)

#: A snapshot that is being written for a node before its start.
_BEGUN: Final = "state.new"


class SlotWriter:
    """Writer of a node's snapshots into its two slots in turn, never over the newest one.

    Args:
        directory: directory of the process; created if it does not exist.
        process: name of the process.
        instance: number of the writing instance.

    Raises:
        OSError: the files cannot be opened.
    """

    def __init__(self, directory: Path, process: str, instance: int) -> None:
        self._directory = directory
        self._process = process
        self._instance = instance
        self._files: list[int] = []
        ages = [_age_if_whole(directory / name) for name in SLOTS]
        self._next = ages.index(min(ages))
        self._open()

    def _open(self) -> None:
        self.close()
        self._directory.mkdir(mode=0o700, parents=True, exist_ok=True)
        flags = os.O_RDWR | os.O_CREAT | OPEN
        try:
            for name in SLOTS:
                self._files.append(os.open(self._directory / name, flags, 0o600))
        except OSError:
            self.close()
            raise

    def write(self, sequence: int, blocks: Sequence[Block]) -> bool:
        """Overwrite the older snapshot; a kill at any instant leaves the newer one complete.

        Return False, with nothing changed, if a newer instance writes here.

        Raises:
            OSError: the snapshot cannot be written; the newer one is still complete.
        """
        if not self._files or any(os.fstat(one).st_nlink == 0 for one in self._files):
            self._open()  # the slots were deleted with the snapshots of earlier instances
        file = self._files[self._next]
        if self._is_of_newer(file):
            return False
        head = encoded_head(self._process, self._instance, sequence, blocks)
        size = len(head) + sum(len(block.data) for block in blocks)
        # The header is written last, so an interrupted write never looks like the newest snapshot.
        _write_all(file, [block.data for block in blocks], len(head))
        _write_all(file, [head], 0)
        if os.fstat(file).st_size > 2 * size:
            os.ftruncate(file, size)
        self._next = 1 - self._next
        return True

    def _is_of_newer(self, file: int) -> bool:
        with contextlib.suppress(Damaged, OSError):
            return decoded_head(os.pread(file, HEAD_ROOM, 0))[0].instance > self._instance
        return False

    def close(self) -> None:
        """Release the files."""
        while self._files:
            os.close(self._files.pop())


def _age_if_whole(path: Path) -> tuple[int, int]:
    try:
        return checked(content_of(path))[0].age
    except Damaged:
        return (0, 0)


#: Most buffers of one call (IOV_MAX is 1024).
_AT_ONCE: Final = 512


def _write_all(file: int, parts: Sequence[bytes], at: int) -> None:
    waiting = [memoryview(part) for part in parts if part]
    while waiting:
        written = os.pwritev(file, waiting[:_AT_ONCE], at)
        at += written
        while waiting and written >= len(waiting[0]):
            written -= len(waiting.pop(0))
        if written:
            waiting[0] = waiting[0][written:]


class CopyWriter:
    """Writer of a replica from another host; the earlier replica stays until `finish`.

    Args:
        directory: of the process; created where it does not exist.

    Attributes:
        path: of the unfinished replica.
        size: bytes so far.

    Raises:
        OSError: the file cannot be opened.
    """

    def __init__(self, directory: Path) -> None:
        directory.mkdir(mode=0o700, parents=True, exist_ok=True)
        self._directory = directory
        self.path = directory / f"{COPY}.new"
        flags = os.O_RDWR | os.O_CREAT | os.O_TRUNC | OPEN
        self._file = os.open(self.path, flags, 0o600)
        self.size = 0

    def append(self, data: bytes) -> None:
        """Append the next part; raises `OSError`."""
        _write_all(self._file, [data], self.size)
        self.size += len(data)

    def check(self, process: str, age: tuple[int, int]) -> Head:
        """Return the header of the complete replica.

        Raises:
            Damaged: the replica is not complete, or of another process or age.
            OSError: the replica cannot be read.
        """
        head = checked_replica(self.path)
        check_origin(head, process, age)
        return head

    def finish(self) -> None:
        """Force this replica to the disk, then replace the earlier one; raises `OSError`.

        A loss of power leaves one of the two, because only the new name may be missing.
        """
        durable.sync(str(self.path))
        self.path.replace(self._directory / COPY)
        self._close()

    def abandon(self) -> None:
        """Delete the unfinished replica."""
        self._close()
        with contextlib.suppress(OSError):
            self.path.unlink(missing_ok=True)
        with contextlib.suppress(OSError):
            self._directory.rmdir()  # fails, as intended, if the directory holds other files

    def _close(self) -> None:
        if self._file >= 0:
            os.close(self._file)
            self._file = -1


def check_origin(head: Head, process: str, age: tuple[int, int]) -> None:
    """Raise `Damaged` if a snapshot is of another process or age."""
    if (head.process, head.age) != (process, age):
        raise Damaged(f"it is a state of {head.process}#{head.instance}")


def write_slot(directory: Path, content: bytes) -> None:
    """Replace the older one of a node's two snapshots durably by this content; raises `OSError`."""
    ages = {directory / name: _age_if_whole(directory / name) for name in SLOTS}
    begun = directory / _BEGUN
    begun.unlink(missing_ok=True)
    file = os.open(begun, os.O_WRONLY | os.O_CREAT | os.O_EXCL | OPEN, 0o600)
    try:
        _write_all(file, [content], 0)
        durable.rename_durably(str(begun), str(min(ages, key=lambda path: ages[path])))
    except OSError:
        begun.unlink(missing_ok=True)
        raise
    finally:
        os.close(file)


def drop_torn(directory: Path) -> list[Path]:
    """Delete the slots that look newer than the newest complete one; return their paths.

    A loss of power may leave the new header of a slot without its new content. That header would
    count as the newest snapshot, also compared with replicas on other hosts. A slot that its node
    is writing now is not deleted.

    Raises:
        OSError: too many files are open, or memory is short.
    """
    torn = []
    for path, _ in snapshot_files(directory):
        before = status(path)
        try:
            checked(content_of(path))
            break
        except Unreadable:
            continue
        except Damaged:
            if path.name in SLOTS and before is not None and _is_same(before, status(path)):
                with contextlib.suppress(
                    OSError
                ):  # a read-only disk, on which no process can start
                    path.unlink(missing_ok=True)
                    torn.append(path)
    return torn


def _is_same(before: os.stat_result, after: os.stat_result | None) -> bool:
    return after is not None and before.st_mtime_ns == after.st_mtime_ns


def drop_snapshots(directory: Path, up_to: int) -> bool:
    """Delete the snapshots of instances up to a number; return True if none is left.

    Raises:
        OSError: a file cannot be read now, and may be of a later instance; it stays.
    """
    left = False
    for path in paths_of(directory):
        try:
            stays = head_of(path).instance > up_to
        except (FileNotFoundError, Damaged):
            stays = False
        left |= stays
        if not stays:
            with contextlib.suppress(OSError):
                path.unlink(missing_ok=True)
    if not left:
        with contextlib.suppress(OSError):
            (directory / f"{COPY}.new").unlink(missing_ok=True)
            (directory / _BEGUN).unlink(missing_ok=True)
            directory.rmdir()
    return not left
