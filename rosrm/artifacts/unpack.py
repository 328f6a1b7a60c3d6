"""Archive of an artifact as files on the host of a process. The content is not trusted."""

from __future__ import annotations

import os
import shutil
import stat
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Final

from rosrm.errors import TransferError
from rosrm.model.artifacts import name_fault
from rosrm.shortage import raise_shortage

if TYPE_CHECKING:
    from tarfile import TarInfo

#: Name of the file or directory in an archive, and where it is unpacked.
CONTENT: Final = "content"
#: Most files, directories and links of one artifact.
MOST_ENTRIES: Final = 20_000
#: Time of modification of all that is unpacked (1980-01-01); another one shows a change.
_TIME: Final = 315_532_800
_TIMES: Final = (_TIME, _TIME)
_NEW: Final = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC
_WRITABLE: Final = stat.S_IWUSR | stat.S_IWGRP | stat.S_IWOTH


def link_fault(name: str, target: str) -> str:
    """Return why a link may not have a target, by their texts alone; "" if it may."""
    if not target or target.startswith("/"):
        return f"{target!r:.200} is absolute, or empty"
    inside = os.path.normpath(Path(name).parent / target)
    if inside == ".." or inside.startswith("../"):
        return f"{target!r:.200} lies outside of the directory"
    return ""


def unpack(archive: Path, directory: Path) -> None:
    """Unpack an archive into a new directory; all in it is read-only.

    Raises:
        TransferError: it is no sound archive, or has an entry that is not allowed.
        OSError: something cannot be written.
    """
    import tarfile  # noqa: PLC0415 - the slave, whose memory is budgeted, seldom needs it

    from rosrm.artifacts.tar_entries import BoundedEntry  # noqa: PLC0415 - the same

    directory.mkdir(mode=0o700)
    links: list[TarInfo] = []
    directories: list[str] = []
    try:
        with tarfile.open(archive, "r:", tarinfo=BoundedEntry) as tar:
            count = 0
            while (entry := tar.next()) is not None:
                tar.members.clear()  # type: ignore[attr-defined]  # it keeps each entry with its headers
                count += 1
                if count > MOST_ENTRIES:
                    raise TransferError(f"it has more than {MOST_ENTRIES} entries")
                _check(entry)
                path = directory / entry.name
                if entry.issym():
                    links.append(entry)
                elif entry.isdir():
                    path.mkdir(mode=0o700)
                    directories.append(entry.name)
                else:
                    _write(tar, entry, path)
    except (
        tarfile.TarError, ValueError, FileExistsError, FileNotFoundError, RecursionError,
    ) as error:  # fmt: skip
        raise TransferError(f"it is no sound archive: {error}") from None
    # Links come last, so that no file is written through one.
    for entry in links:
        _link(directory, entry)
    for name in reversed(directories):
        (directory / name).chmod(0o555)
        os.utime(directory / name, _TIMES)


def is_intact(directory: Path) -> bool:
    """Return True if nothing has changed below a directory since it was unpacked.

    Raises:
        OSError: it cannot be looked at now.
    """
    content = directory / CONTENT
    try:
        return all(map(_is_untouched, _paths(content)))
    except OSError as error:
        raise_shortage(error)
        return False


def remove(directory: Path) -> None:
    """Delete a directory with read-only directories in it; a missing one is no error.

    Raises:
        OSError: it cannot be deleted.
    """
    if not directory.exists():
        return
    for root, _, _ in os.walk(directory):
        Path(root).chmod(0o700)
    shutil.rmtree(directory)


def _paths(content: Path) -> Iterator[str]:
    """Yield a file, or a directory and all that is in it; raises `OSError`."""
    yield str(content)
    if content.is_dir():
        for root, directories, files in os.walk(content, onerror=_fail):
            yield from (f"{root}/{name}" for name in (*directories, *files))


def _fail(error: OSError) -> None:
    raise error


def _is_untouched(path: str) -> bool:
    status = os.lstat(path)
    if stat.S_ISLNK(status.st_mode):
        return True
    return int(status.st_mtime) == _TIME and not status.st_mode & _WRITABLE


def _check(entry: TarInfo) -> None:
    """Raise `TransferError` for an entry that is not allowed."""
    if entry.name != CONTENT:
        top, _, name = entry.name.partition("/")
        fault = name_fault(name) if top == CONTENT else f"{entry.name!r:.200} lies outside of it"
        if fault:
            raise TransferError(fault)
    is_file = entry.isreg() and not entry.issparse()  # a short archive may have a huge sparse file
    if not (is_file or entry.isdir() or (entry.issym() and entry.name != CONTENT)):
        raise TransferError(f"{entry.name!r:.200} is neither a file, a directory nor a link")
    if entry.issym():
        fault = link_fault(entry.name.partition("/")[2], entry.linkname)
        if fault:
            raise TransferError(f"{entry.name!r:.200} is a link: {fault}")


def _write(tar: object, entry: TarInfo, path: Path) -> None:
    source = tar.extractfile(entry)  # type: ignore[attr-defined]
    descriptor = os.open(path, _NEW, 0o600)
    with os.fdopen(descriptor, "wb") as file:
        shutil.copyfileobj(source, file, 1 << 18)
        os.fchmod(descriptor, 0o555 if entry.mode & stat.S_IXUSR else 0o444)
    os.utime(path, _TIMES)


def _link(directory: Path, entry: TarInfo) -> None:
    path = directory / entry.name
    try:
        path.symlink_to(entry.linkname)
    except (FileExistsError, FileNotFoundError, NotADirectoryError):
        raise TransferError(f"{entry.name!r:.200} is given twice or out of order") from None
    if not path.resolve().is_relative_to((directory / CONTENT).resolve()):
        raise TransferError(f"{entry.name!r:.200} is a link that leads out of the artifact")
