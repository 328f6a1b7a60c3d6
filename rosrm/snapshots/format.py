"""Format of a snapshot, the same in a file and in transfer to another host. Pure."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from mmap import mmap
from pathlib import Path
from typing import Final, NamedTuple

from rosrm.wording import reason_of

#: Most bytes of a file, and most blocks; a larger file is no snapshot.
LARGEST: Final = 2 << 30
#: Most bytes of a replica: encryption adds a header, a nonce and a tag.
LARGEST_REPLICA: Final = LARGEST + 4096
_MOST_BLOCKS: Final = 1000
#: Numbers of instances and cycles are smaller; greater ones would overflow when they grow.
MOST_CYCLES: Final = 1 << 62

_MAGIC: Final = b"rosrmKS1"
#: Magic of an encrypted replica, whose blocks are a nonce and an encrypted snapshot.
_ENCRYPTED: Final = b"rosrmKE1"
#: Magic, instance, sequence, bytes of the name, blocks.
_FIXED: Final = struct.Struct("<8sQQII")
#: Bytes and CRC-32 of one block.
_BLOCK: Final = struct.Struct("<QI")
_CRC: Final = struct.Struct("<I")


class Damaged(Exception):
    """A file holds no complete snapshot; the text gives the reason."""


class Unreadable(Damaged):
    """A file cannot be read now; its content may be sound, so it is not deleted.

    Attributes:
        error: of the file.
    """

    def __init__(self, error: OSError) -> None:
        super().__init__(f"it cannot be read: {reason_of(error)}")
        self.error = error


class Block(NamedTuple):
    """One block of the content, with its CRC-32."""

    data: bytes
    digest: int


@dataclass(frozen=True, slots=True)
class Head:
    """The header of a snapshot file.

    Attributes:
        process: name of the process.
        instance: number of the instance that was in this state.
        sequence: cycles that the snapshot covers.
        blocks: bytes and CRC-32 of each.
        size: bytes of the whole file, header included.
        encrypted: True: an encrypted replica, which no node can read.
    """

    process: str
    instance: int
    sequence: int
    blocks: tuple[tuple[int, int], ...]
    size: int
    encrypted: bool = False

    @property
    def age(self) -> tuple[int, int]:
        """Sort key: the larger, the newer."""
        return self.instance, self.sequence


@dataclass(frozen=True, slots=True)
class Listing:
    """A complete snapshot.

    Attributes:
        blocks: the mark, then each part of the state, serialised; in an encrypted replica the nonce
            and the encrypted snapshot.
        path: file that the snapshot was read from.
    """

    head: Head
    blocks: tuple[bytes, ...]
    path: Path


class TransferPart(NamedTuple):
    """Part of a snapshot in transfer to another host.

    Attributes:
        number, sequence: number of the instance, and sequence of the snapshot.
        offset: bytes before this part.
        total: bytes of the whole snapshot.
        digest: CRC-32 of the whole snapshot.
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
        """Sort key: the larger, the newer."""
        return self.number, self.sequence

    @property
    def is_last(self) -> bool:
        """Return True if no part follows."""
        return self.offset + len(self.data) >= self.total


def encoded_head(
    process: str, instance: int, sequence: int, blocks: Sequence[Block], *, encrypted: bool = False
) -> bytes:
    """Return the header of a file."""
    name = process.encode()
    magic = _ENCRYPTED if encrypted else _MAGIC
    head = b"".join(
        [
            _FIXED.pack(magic, instance, sequence, len(name), len(blocks)),
            name,
            *(_BLOCK.pack(len(block.data), block.digest) for block in blocks),
        ]
    )
    return head + _CRC.pack(zlib.crc32(head))


def decoded_head(data: bytes | mmap) -> tuple[Head, int]:
    """Return the header of a file, and the offset of its first block.

    Raises:
        Damaged: the bytes are no header, or not a complete one.
    """
    try:
        magic, instance, sequence, name_size, count = _FIXED.unpack_from(data)
        end = _FIXED.size + name_size + count * _BLOCK.size
        if magic not in (_MAGIC, _ENCRYPTED) or count > _MOST_BLOCKS or end + _CRC.size > len(data):
            raise Damaged("it is no snapshot")
        if max(instance, sequence) >= MOST_CYCLES:
            raise Damaged("no instance has such a number, or so many cycles")
        if _CRC.unpack_from(data, end)[0] != zlib.crc32(data[:end]):
            raise Damaged("its head is damaged")
        name = data[_FIXED.size : _FIXED.size + name_size].decode()
    except (struct.error, UnicodeDecodeError):
        raise Damaged("it is no snapshot") from None
    table = data[_FIXED.size + name_size : end]
    blocks = tuple(_BLOCK.iter_unpack(table))
    start = end + _CRC.size
    size = start + sum(size for size, _ in blocks)
    encrypted = magic == _ENCRYPTED
    if size > (LARGEST_REPLICA if encrypted else LARGEST):
        raise Damaged("it claims to be larger than a state can be")
    return Head(name, instance, sequence, blocks, size, encrypted), start


def checked(data: bytes | mmap) -> tuple[Head, int]:
    """Return the result of `decoded_head` for a complete file; raise `Damaged` for any other."""
    head, start = decoded_head(data)
    if len(data) < head.size:
        raise Damaged(f"it ends after {len(data)} of {head.size} bytes")
    at, view = start, memoryview(data)  # no copies: a file may have hundreds of megabytes
    for size, digest in head.blocks:
        if zlib.crc32(view[at : at + size]) != digest:
            raise Damaged("its content does not match its checksum")
        at += size
    return head, start


def decoded(data: bytes, path: Path = Path()) -> Listing:
    """Return the snapshot in a complete file; raises `Damaged`."""
    head, at = checked(data)
    blocks = []
    for size, _ in head.blocks:
        blocks.append(data[at : at + size])
        at += size
    return Listing(head, tuple(blocks), path)
