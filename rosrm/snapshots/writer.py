"""Writes states: a node into two slots in turn, a slave those of other hosts; and deletes them."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from rosrm.snapshots.format import Block, Damaged, Head, checked, decoded_head, encoded_head
from rosrm.snapshots.reader import COPY, HEAD_ROOM, OPEN, SLOTS, content_of, paths_of, peek


class SlotWriter:
    """Writes a node's states into its two slots in turn, never over the newest one.

    Args:
        directory: of the process; it is made where it does not exist.
        process: its name.
        instance: number of the instance that writes.

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
        """Write a state over the older one; killed at any instant, the newer one is still whole.

        Returns:
            False: a newer instance writes here; nothing was changed.

        Raises:
            OSError: it cannot be written; the newer one is still whole.
        """
        if not self._files or any(os.fstat(one).st_nlink == 0 for one in self._files):
            self._open()  # what is kept of an instance before this one was deleted meanwhile
        file = self._files[self._next]
        if self._is_of_newer(file):
            return False
        head = encoded_head(self._process, self._instance, sequence, blocks)
        size = len(head) + sum(len(block.data) for block in blocks)
        # The head goes last: a file that was begun and not ended never looks like the newest.
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
    """Takes a state that comes from another host, part by part; the copy before it stays till then.

    Args:
        directory: of the process; it is made where it does not exist.

    Raises:
        OSError: the file cannot be opened.
    """

    def __init__(self, directory: Path) -> None:
        directory.mkdir(mode=0o700, parents=True, exist_ok=True)
        self._directory = directory
        self._begun = directory / f"{COPY}.new"
        flags = os.O_RDWR | os.O_CREAT | os.O_TRUNC | OPEN
        self._file = os.open(self._begun, flags, 0o600)
        self.size = 0

    def append(self, data: bytes) -> None:
        """Take the next part; raises `OSError`."""
        _write_all(self._file, [data], self.size)
        self.size += len(data)

    def finish(self) -> Head:
        """It is whole: keep it.

        Raises:
            Damaged: it is not; nothing is left of it.
            OSError: it cannot be kept.
        """
        try:
            head, _ = checked(content_of(self._begun))
            self._begun.replace(self._directory / COPY)
        except (Damaged, OSError):
            self.abandon()
            raise
        self._close()
        return head

    def abandon(self) -> None:
        """Nothing more comes of it."""
        self._close()
        with contextlib.suppress(OSError):
            self._begun.unlink(missing_ok=True)
        with contextlib.suppress(OSError):
            self._directory.rmdir()  # where nothing else is kept

    def _close(self) -> None:
        if self._file >= 0:
            os.close(self._file)
            self._file = -1


def write_copy(directory: Path, data: bytes) -> None:
    """Keep a state that came from another host; raises as `CopyWriter` does."""
    copy = CopyWriter(directory)
    try:
        copy.append(data)
    except OSError:
        copy.abandon()
        raise
    copy.finish()


def drop(directory: Path, up_to: int) -> bool:
    """Delete the states of instances up to a number; True: nothing is kept any more."""
    left = False
    for path in paths_of(directory):
        head = peek(path)
        if head is not None and head.instance > up_to:
            left = True
        else:
            with contextlib.suppress(OSError):
                path.unlink(missing_ok=True)
    if not left:
        with contextlib.suppress(OSError):
            (directory / f"{COPY}.new").unlink(missing_ok=True)
            directory.rmdir()
    return not left
