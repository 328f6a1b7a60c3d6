r"""File format of a recording: a line with its version, then frames with length and checksum.

    rosrm-record 1\n
    frame*                  length u32, CRC-32 u32 (both little-endian), then `length` bytes

The first byte of a frame is its kind (`FrameKind`). The first frame is the header. The last frame
of a closed recording states why the recording ends. A file without that frame is cut short. A file
with only zeros after some frame is also cut short, because a power loss leaves zeros for bytes that
were not on the disk yet.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from enum import Enum
from typing import BinaryIO, Final

from rosrm.errors import RecordError

#: Version of the format; files of other versions are refused.
RECORD_VERSION: Final = 1
MAGIC: Final = b"rosrm-record "
_PREFIX: Final = struct.Struct("<II")
#: Largest length of a frame in bytes; a larger one is damage, and nothing is allocated for it.
_LARGEST: Final = 2**30
_LONGEST_LINE: Final = 64
#: Bytes per read in the search for zeros.
_AT_ONCE: Final = 2**20


class FrameKind(bytes, Enum):
    """Kind of a frame."""

    HEADER = b"H"
    EVENT = b"E"
    READINGS = b"R"
    USAGES = b"U"
    DECISIONS = b"D"
    END = b"Z"


def opening() -> bytes:
    """Return the first line of a recording."""
    return MAGIC + f"{RECORD_VERSION}\n".encode()


def is_record(beginning: bytes) -> bool:
    """Return True if a file with this beginning is a recording, of any version."""
    return beginning.startswith(MAGIC)


def frame(kind: FrameKind, content: bytes) -> bytes:
    """Return one frame as bytes of the file."""
    body = kind.value + content
    return _PREFIX.pack(len(body), zlib.crc32(body)) + body


def frames(file: BinaryIO, name: str) -> Iterator[tuple[FrameKind, bytes, int]]:
    """Return the frames of a recording, each with its kind, its content and its offset in bytes.

    Args:
        file: opened at its beginning.
        name: name of the file, for messages.

    Raises:
        RecordError: no recording, another version, damaged, or cut within a frame.
    """
    at = _check_opening(file, name)
    while prefix := file.read(_PREFIX.size):
        if len(prefix) < _PREFIX.size:
            raise cut_short(name, at)
        length, checksum = _PREFIX.unpack(prefix)
        if not 0 < length <= _LARGEST:
            raise _broken(file, prefix, name, at)
        body = file.read(length)
        if len(body) < length:
            raise cut_short(name, at)
        if zlib.crc32(body) != checksum:
            raise _broken(file, body, name, at)
        try:
            kind = FrameKind(body[:1])
        except ValueError:
            raise _damaged(name, at) from None
        yield kind, body[1:], at
        at += _PREFIX.size + length


def _check_opening(file: BinaryIO, name: str) -> int:
    line = file.readline(_LONGEST_LINE).rstrip(b"\0")
    if not line.startswith(MAGIC):
        raise RecordError(
            f"{name}: is no recording of a master's run: it does not begin with "
            f"{MAGIC.decode().strip()!r}. A master writes one with `record:` in its cluster.yaml"
        )
    if line != opening():
        if not line.endswith(b"\n") and opening().startswith(line):
            raise cut_short(name, 0)
        version = line[len(MAGIC) :].strip().decode(errors="replace")
        raise RecordError(
            f"{name}: is a recording of version {version}; this rosrm reads version "
            f"{RECORD_VERSION}. Use the rosrm that wrote the file"
        )
    return len(line)


def cut_short(name: str, at: int) -> RecordError:
    """Return the error of a file without the end of its recording."""
    return CutShort(
        f"{name}: the recording is cut short at byte {at}: its master was killed, lost its power, "
        f"still runs, or the file was not copied as a whole. --cut accepts the complete part"
    )


class CutShort(RecordError):
    """The recording has no end; the frames before are complete."""


def _broken(file: BinaryIO, read: bytes, name: str, at: int) -> RecordError:
    """Return the error of an invalid frame: cut short if only zeros follow, else damaged."""
    if read.endswith(b"\0"):
        while rest := file.read(_AT_ONCE):
            if rest.strip(b"\0"):
                break
        else:
            return cut_short(name, at)
    return _damaged(name, at)


def _damaged(name: str, at: int) -> RecordError:
    return RecordError(
        f"{name}: the recording is damaged at byte {at}: the frame there has an invalid length, "
        f"checksum or kind. Nothing of the file was used"
    )
