"""States that are kept: the files of one process, as its node and its slave write and read them.

A directory belongs to one process. Its node writes `state.0` and `state.1` in turn, so that one of
them is whole whenever it is killed; its slave writes `copy`, a state that came from another host.
The newest whole one counts. docs/reference/handoff-protocol.md has the format.
"""

from __future__ import annotations

import contextlib
import os
import struct
import zlib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final, NamedTuple

#: Written by the node, in turn.
SLOTS: Final = ("state.0", "state.1")
#: Written by the slave.
COPY: Final = "copy"
#: Most bytes of a file, and most blocks: what is larger is no state of ours.
LARGEST: Final = 2 << 30
_MOST_BLOCKS: Final = 1000

_MAGIC: Final = b"rosrmKS1"
#: Magic, instance, sequence, bytes of the name, blocks.
_FIXED: Final = struct.Struct("<8sQQII")
#: Bytes and CRC-32 of one block.
_BLOCK: Final = struct.Struct("<QI")
_CRC: Final = struct.Struct("<I")
_OPEN: Final = os.O_CLOEXEC | os.O_NOFOLLOW


class Damaged(Exception):
    """A file that holds no whole state: which, and why."""


class Block(NamedTuple):
    """A part of the content, with its CRC-32."""

    data: bytes
    digest: int


@dataclass(frozen=True, slots=True)
class Head:
    """What a file says of itself.

    Attributes:
        process: name of the process.
        instance: number of the instance that was in this state.
        sequence: cycles that it covers.
        blocks: bytes and CRC-32 of each.
        size: bytes of the whole, this head included.
    """

    process: str
    instance: int
    sequence: int
    blocks: tuple[tuple[int, int], ...]
    size: int

    @property
    def age(self) -> tuple[int, int]:
        """The larger, the newer."""
        return self.instance, self.sequence


@dataclass(frozen=True, slots=True)
class Kept:
    """A whole state.

    Attributes:
        blocks: the mark, then each part of the state, serialised.
        path: where it was read.
    """

    head: Head
    blocks: tuple[bytes, ...]
    path: Path


class Part(NamedTuple):
    """A part of a state on its way.

    Attributes:
        number, sequence: of the instance, and of the state.
        offset: bytes, where it begins.
        total: bytes of the whole.
        digest: CRC-32 of the whole.
    """

    process: str
    number: int
    sequence: int
    offset: int
    total: int
    digest: int
    data: bytes

    @property
    def age(self) -> tuple[int, int]:
        """The larger, the newer."""
        return self.number, self.sequence

    @property
    def is_last(self) -> bool:
        """Nothing comes after it."""
        return self.offset + len(self.data) >= self.total


# --- the format -------------------------------------------------------------------------------


def encoded_head(process: str, instance: int, sequence: int, blocks: Sequence[Block]) -> bytes:
    """The head of a file."""
    name = process.encode()
    head = b"".join(
        [
            _FIXED.pack(_MAGIC, instance, sequence, len(name), len(blocks)),
            name,
            *(_BLOCK.pack(len(block.data), block.digest) for block in blocks),
        ]
    )
    return head + _CRC.pack(zlib.crc32(head))


def decoded_head(data: bytes) -> tuple[Head, int]:
    """What a file begins with, and where its blocks begin.

    Raises:
        Damaged: it is no head, or not a whole one.
    """
    try:
        magic, instance, sequence, name_size, count = _FIXED.unpack_from(data)
        end = _FIXED.size + name_size + count * _BLOCK.size
        if magic != _MAGIC or count > _MOST_BLOCKS or end + _CRC.size > len(data):
            raise Damaged("it is no kept state")
        if _CRC.unpack_from(data, end)[0] != zlib.crc32(data[:end]):
            raise Damaged("its head is damaged")
        name = data[_FIXED.size : _FIXED.size + name_size].decode()
    except (struct.error, UnicodeDecodeError):
        raise Damaged("it is no kept state") from None
    table = data[_FIXED.size + name_size : end]
    blocks = tuple(_BLOCK.iter_unpack(table))
    start = end + _CRC.size
    size = start + sum(size for size, _ in blocks)
    if size > LARGEST:
        raise Damaged("it claims to be larger than a state can be")
    return Head(name, instance, sequence, blocks, size), start


def decoded(data: bytes, path: Path = Path()) -> Kept:
    """A whole file; raises `Damaged`."""
    head, at = decoded_head(data)
    if len(data) < head.size:
        raise Damaged(f"it ends after {len(data)} of {head.size} bytes")
    blocks = []
    for size, digest in head.blocks:
        block = data[at : at + size]
        if zlib.crc32(block) != digest:
            raise Damaged("its content does not match its checksum")
        blocks.append(block)
        at += size
    return Kept(head, tuple(blocks), path)


# --- reading ----------------------------------------------------------------------------------

#: More than any head of ours.
_HEAD_ROOM: Final = 64 << 10


def peek(path: Path) -> Head | None:
    """The head of a file alone, its content unseen; None: there is no such file, or no head."""
    try:
        descriptor = os.open(path, os.O_RDONLY | _OPEN)
    except OSError:
        return None
    try:
        return decoded_head(os.read(descriptor, _HEAD_ROOM))[0]
    except (OSError, Damaged):
        return None
    finally:
        os.close(descriptor)


def files(directory: Path) -> list[tuple[Path, Head]]:
    """Files with a sound head, the newest first."""
    found = [(path, head) for path in _paths(directory) if (head := peek(path)) is not None]
    return sorted(found, key=lambda one: one[1].age, reverse=True)


def _paths(directory: Path) -> Iterable[Path]:
    return (directory / name for name in (*SLOTS, COPY))


def newest_head(directory: Path) -> Head | None:
    """What the newest file says of itself; None: there is none."""
    found = files(directory)
    return found[0][1] if found else None


def read(path: Path) -> Kept:
    """A whole state; raises `Damaged`."""
    return decoded(_content(path), path)


def _content(path: Path) -> bytes:
    try:
        descriptor = os.open(path, os.O_RDONLY | _OPEN)
        with os.fdopen(descriptor, "rb") as file:
            return file.read(LARGEST + 1)
    except OSError as error:
        raise Damaged(f"it cannot be read: {error.strerror}") from None


def newest(directory: Path, up_to: int) -> tuple[Kept | None, list[str]]:
    """The newest whole state of a directory, and what is wrong with those that are not whole.

    Args:
        up_to: highest number of an instance whose state counts.
    """
    found = files(directory)
    sound = {path for path, _ in found}
    faults = [
        f"{path}: its head is damaged"
        for path in _paths(directory)
        if path not in sound and path.is_file() and path.stat().st_size
    ]
    for path, head in found:
        if head.instance > up_to:
            continue
        try:
            return read(path), faults
        except Damaged as fault:
            faults.append(f"{path}: {fault}")
    return None, faults


def newest_content(directory: Path) -> tuple[Head, bytes] | None:
    """The newest whole state as it lies in its file; None: there is none."""
    for path, _ in files(directory):
        with contextlib.suppress(Damaged):
            data = _content(path)
            head = decoded(data, path).head
            return head, data[: head.size]
    return None


# --- writing ----------------------------------------------------------------------------------


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
        directory.mkdir(mode=0o700, parents=True, exist_ok=True)
        self._process = process
        self._instance = instance
        self._files: list[int] = []
        ages = [_age_if_whole(directory / name) for name in SLOTS]
        self._next = ages.index(min(ages))
        flags = os.O_RDWR | os.O_CREAT | _OPEN
        try:
            self._files += [os.open(directory / name, flags, 0o600) for name in SLOTS]
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
            return decoded_head(os.pread(file, _HEAD_ROOM, 0))[0].instance > self._instance
        return False

    def close(self) -> None:
        """Release the files."""
        while self._files:
            os.close(self._files.pop())


def _age_if_whole(path: Path) -> tuple[int, int]:
    try:
        return read(path).head.age
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
        flags = os.O_RDWR | os.O_CREAT | os.O_TRUNC | _OPEN
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
            head = read(self._begun).head
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
    for path in _paths(directory):
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
