"""Replacement of a directory in CRIU's image by another one on the host of the restore.

Processes without a configured working directory run in the supervisor's, whose path contains the
name of its host. CRIU opens files by the paths in its image, so these paths are changed there.
Copies of the paths in the memory of the process stay unchanged.

In `files.img` each message is an open file; its field 3 is a regular file or a directory, and the
path is the only string in that field.
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
from rosrm_criu.engine import protobuf
from rosrm_criu.engine.image import HERE, link_or_copy

_FILES: Final = "files.img"
#: Field of a FileEntry with a regular file or directory.
_REGULAR: Final = 3


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
    try:
        shutil.copytree(directory, beside, copy_function=link_or_copy, ignore=lambda *_: (_FILES,))
        beside.chmod(0o700)
        data = _files((directory / _FILES).read_bytes(), lambda path: moved(path, old, new))
        (beside / _FILES).write_bytes(data)
        yield beside
    except ValueError as error:
        raise CriuError(f"{directory / _FILES} is damaged: {error}") from None
    finally:
        shutil.rmtree(beside, ignore_errors=True)


def _files(data: bytes, change: Callable[[str], str]) -> bytes:
    changed = [data[: protobuf.MAGIC]]
    for message in protobuf.messages(data):
        new = _fields(message, lambda number, value: _entry(number, value, change))
        changed.append(struct.pack("<I", len(new)) + new)
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
    for one in protobuf.fields(message):
        if isinstance(one.value, bytes):
            changed.append(protobuf.encoded_bytes(one.number, change(one.number, one.value)))
        else:
            changed.append(one.raw)
    return b"".join(changed)
