"""Replacement of a directory in CRIU's image by another one on the host of the restore.

Processes without a configured working directory run in the supervisor's, whose path contains the
name of its host. CRIU opens files by the paths in its image, so these paths are changed there.
Copies of the paths in the memory of the process stay unchanged.

A CRIU image file consists of two magic numbers and Protocol Buffers messages, each preceded by its
size. In `files.img` each message is an open file; its field 3 is a regular file or a directory,
and the path is the only string in that field.
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
from rosrm_criu.engine.image import HERE, link_or_copy

_FILES: Final = "files.img"
#: Bytes before the first message.
_MAGIC: Final = 8
#: Field of a FileEntry with a regular file or directory.
_REGULAR: Final = 3
#: Wire types: varint; eight bytes; bytes preceded by their length; four bytes.
_NUMBER, _EIGHT, _BYTES, _FOUR = 0, 1, 2, 5


def moved(path: str, old: str, new: str) -> str:
    """Return a path with one directory replaced by another.

    Args:
        path: absolute.
        old: the directory to replace; "": none.
        new: its replacement; "": none.
    """
    if old and new and (path == old or path.startswith(f"{old}/")):
        return new + path[len(old) :]
    return path


@contextlib.contextmanager
def images(directory: Path, old: str, new: str) -> Iterator[Path]:
    """Yield a temporary copy of CRIU's images with other paths; the image itself stays unchanged.

    Args:
        directory: of CRIU's images.
        old: directory that the process knows; "": it is the same on this host.
        new: its replacement.

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
                link_or_copy(file, beside / file.name)
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
    """Return a field of an open file, with changed paths."""
    if number != _REGULAR:
        return value
    return _fields(value, lambda _, text: _text(text, change))


def _text(value: bytes, change: Callable[[str], str]) -> bytes:
    """Return a field of a regular file; a value that begins with "/" is its path and is changed."""
    return os.fsencode(change(os.fsdecode(value))) if value.startswith(b"/") else value


def _fields(message: bytes, change: Callable[[int, bytes], bytes]) -> bytes:
    """Return a message with `change` applied to its fields of bytes."""
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
    """Return a varint and the position after it."""
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
