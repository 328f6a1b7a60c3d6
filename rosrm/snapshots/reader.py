"""Lookup of the newest complete snapshot in the directory of a process."""

from __future__ import annotations

import contextlib
import mmap
import os
from collections.abc import Iterable
from pathlib import Path
from typing import Final

from rosrm.shortage import raise_shortage
from rosrm.snapshots.format import (
    LARGEST_REPLICA,
    Damaged,
    Head,
    Listing,
    Unreadable,
    checked,
    decoded,
    decoded_head,
)

#: Written by the node, in turn.
SLOTS: Final = ("state.0", "state.1")
#: Written by the slave.
COPY: Final = "copy"
#: Flags of every file that is opened.
OPEN: Final = os.O_CLOEXEC | os.O_NOFOLLOW
#: Bytes that are read for a header; no header is larger.
HEAD_ROOM: Final = 64 << 10


def peek(path: Path) -> Head | None:
    """Return the header of a file without reading its content; None: no such file, or no header.

    Raises:
        OSError: too many files are open, or memory is short; the snapshot may be there.
    """
    try:
        return head_of(path)
    except OSError as error:
        raise_shortage(error)
        return None
    except Damaged:
        return None


def head_of(path: Path) -> Head:
    """Return the header of a file without reading its content.

    Raises:
        Damaged: the file has no sound header.
        OSError: there is no file, or it cannot be read.
    """
    descriptor = os.open(path, os.O_RDONLY | OPEN)
    try:
        return decoded_head(os.read(descriptor, HEAD_ROOM))[0]
    finally:
        os.close(descriptor)


def snapshot_files(directory: Path) -> list[tuple[Path, Head]]:
    """Return the files with a sound header, newest first."""
    found = [(path, head) for path in paths_of(directory) if (head := peek(path)) is not None]
    return sorted(found, key=lambda one: one[1].age, reverse=True)


def paths_of(directory: Path) -> Iterable[Path]:
    """Return the files that may hold a snapshot."""
    return (directory / name for name in (*SLOTS, COPY))


def newest_head(directory: Path) -> Head | None:
    """Return the header of the newest file; None: there is none."""
    found = snapshot_files(directory)
    return found[0][1] if found else None


def read(path: Path) -> Listing:
    """Return the snapshot in a file; raises the errors of `content_of`."""
    return decoded(content_of(path), path)


def checked_replica(path: Path) -> Head:
    """Return the header of a complete replica without holding its content.

    Only for a file that no other process writes: a mapped file that is cut ends its reader.

    Raises:
        Damaged: the file is no complete snapshot.
        OSError: the file cannot be read.
    """
    descriptor = os.open(path, os.O_RDONLY | OPEN)
    try:
        mapped = mmap.mmap(descriptor, 0, access=mmap.ACCESS_READ)
    except ValueError:
        raise Damaged("it is empty") from None
    finally:
        os.close(descriptor)
    return checked(mapped)[0]


def content_of(path: Path) -> bytes:
    """Return all bytes of a file.

    Raises:
        Unreadable: the file cannot be read.
        OSError: too many files are open, or memory is short; the file may be sound.
    """
    try:
        descriptor = os.open(path, os.O_RDONLY | OPEN)
        with os.fdopen(descriptor, "rb") as file:
            return file.read(min(os.fstat(descriptor).st_size, LARGEST_REPLICA))
    except OSError as error:
        raise_shortage(error)
        raise Unreadable(error) from None


def newest(directory: Path, up_to: int) -> tuple[Listing | None, list[str]]:
    """Return the newest complete snapshot of instances `up_to` a number, and faults of files."""
    found = snapshot_files(directory)
    sound = {path for path, _ in found}
    faults = [
        f"{path}: its head is damaged"
        for path in paths_of(directory)
        if path not in sound and path.is_file() and path.stat().st_size
    ]
    for path, head in found:
        if head.instance > up_to or head.encrypted:
            continue
        try:
            return read(path), faults
        except Damaged as fault:
            faults.append(f"{path}: {fault}")
    return None, faults


def newest_content(directory: Path) -> tuple[Head, bytes] | None:
    """Return the newest complete snapshot with the bytes of its file; None: there is none."""
    for path, _ in snapshot_files(directory):
        with contextlib.suppress(Damaged):
            data = content_of(path)
            head, _ = checked(data)
            return head, data[: head.size]
    return None
