"""Another directory in the place of one that a process knows: it is not the same on every host.

The processes that name no working directory run in their supervisor's, whose path holds the name of
its host. CRIU opens what it restores by the paths in its image, so these are changed there. What
the process itself has kept of them in its memory stays as it was.

An image of CRIU is two magic numbers, and then messages of Protocol Buffers with their sizes before
them. In `files.img` each is an open file; its field 3 is a regular file or a directory, which has
no other text than its path.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import struct
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Final

from rosrm.errors import CriuError
from rosrm_criu.engine.image import HERE

_FILES: Final = "files.img"
#: What comes before the first message.
_MAGIC: Final = 8
#: Of a FileEntry.
_REGULAR: Final = 3
#: Wire types: a number; eight bytes; bytes with their length before them; four bytes.
_NUMBER, _EIGHT, _BYTES, _FOUR = 0, 1, 2, 5


def moved(path: str, old: str, new: str) -> str:
    """A path, where one directory has taken the place of another; "" moves nothing."""
    if old and new and (path == old or path.startswith(f"{old}/")):
        return new + path[len(old) :]
    return path


@contextlib.contextmanager
def images(directory: Path, old: str, new: str) -> Iterator[Path]:
    """CRIU's images with other paths, for a time; the image itself stays as it is.

    Args:
        directory: of CRIU's images.
        old: directory that the process knows; "": it is the same here.
        new: in its place.

    Raises:
        CriuError: the image is damaged.
    """
    if not old or not new or old == new:
        yield directory
        return
    beside = directory.with_name(HERE)
    shutil.rmtree(beside, ignore_errors=True)
    beside.mkdir(mode=0o700)
    try:
        for file in directory.iterdir():
            if file.name != _FILES:
                os.link(file, beside / file.name)
        data = _files((directory / _FILES).read_bytes(), lambda path: moved(path, old, new))
        (beside / _FILES).write_bytes(data)
        yield beside
    except (struct.error, IndexError, ValueError) as error:
        raise CriuError(f"{directory / _FILES} is damaged: {error}") from None
    finally:
        shutil.rmtree(beside, ignore_errors=True)


def _files(data: bytes, change: Callable[[str], str]) -> bytes:
    changed = [data[:_MAGIC]]
    position = _MAGIC
    while position < len(data):
        (size,) = struct.unpack_from("<I", data, position)
        message = data[position + 4 : position + 4 + size]
        position += 4 + size
        message = _fields(message, lambda number, value: _entry(number, value, change))
        changed.append(struct.pack("<I", len(message)) + message)
    return b"".join(changed)


def _entry(number: int, value: bytes, change: Callable[[str], str]) -> bytes:
    """A field of an open file."""
    if number != _REGULAR:
        return value
    return _fields(value, lambda _, text: _text(text, change))


def _text(value: bytes, change: Callable[[str], str]) -> bytes:
    """A field of a regular file: only its path begins so."""
    return os.fsencode(change(os.fsdecode(value))) if value.startswith(b"/") else value


def _fields(message: bytes, change: Callable[[int, bytes], bytes]) -> bytes:
    """A message whose fields of bytes are changed."""
    changed = []
    position = 0
    while position < len(message):
        begin = position
        key, position = _varint(message, position)
        wire = key & 7
        if wire == _NUMBER:
            _, position = _varint(message, position)
        elif wire in (_EIGHT, _FOUR):
            position += 8 if wire == _EIGHT else 4
        elif wire == _BYTES:
            size, start = _varint(message, position)
            position = start + size
            value = change(key >> 3, message[start:position])
            changed.append(_encoded(key) + _encoded(len(value)) + value)
            continue
        else:
            raise ValueError(f"there is no wire type {wire}")
        changed.append(message[begin:position])
    return b"".join(changed)


def _varint(message: bytes, position: int) -> tuple[int, int]:
    """A number, and where it ends."""
    number = shift = 0
    while True:
        byte = message[position]
        position += 1
        number |= (byte & 0x7F) << shift
        shift += 7
        if byte < 0x80:
            return number, position


def _encoded(number: int) -> bytes:
    out = bytearray()
    while number >= 0x80:
        out.append(number & 0x7F | 0x80)
        number >>= 7
    out.append(number)
    return bytes(out)
