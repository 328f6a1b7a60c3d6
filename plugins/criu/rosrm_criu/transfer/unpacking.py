"""Extraction of an untrusted archive into a directory.

Only directories and regular files are written, only inside the directory, and readable by their
owner alone. Python's own filter for archives also checks each entry.
"""

from __future__ import annotations

import os
import shutil
import tarfile
from pathlib import Path, PurePosixPath
from typing import IO, Any, Final, Protocol

from rosrm.errors import TransferError

_PIECE: Final = 1 << 18
_NEW: Final = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC


class Readable(Protocol):
    """Source of an archive, some bytes per call; none at its end."""

    def read(self, size: int, /) -> bytes:
        """Return at most `size` bytes."""


def unpack(archive: Readable, directory: Path) -> int:
    """Write the content of an archive into an empty directory; return the number of files.

    Raises:
        TransferError: it is no archive, is damaged, or contains something forbidden.
        OSError: something cannot be written.
    """
    files = 0
    try:
        # tarfile calls only read(size).
        source: Any = archive
        with tarfile.open(fileobj=source, mode="r|", bufsize=_PIECE) as tar:
            for entry in tar:
                files += _write(tar, entry, directory)
        while archive.read(_PIECE):
            pass  # tarfile stops at the archive's end mark, but the checksum covers all bytes
    except (tarfile.TarError, EOFError) as error:
        raise TransferError(f"what came is no sound archive: {error}") from None
    return files


def _write(tar: tarfile.TarFile, entry: tarfile.TarInfo, directory: Path) -> int:
    path = directory / _checked(entry, directory)
    try:
        if entry.isdir():
            path.mkdir(mode=0o700)
            return 0
        content = tar.extractfile(entry)
        assert content is not None  # because it is a regular file
        with os.fdopen(os.open(path, _NEW, 0o600), "wb", buffering=0) as file:
            _copy(content, file, entry)
    except (FileExistsError, FileNotFoundError, NotADirectoryError):
        raise TransferError(f"the archive names {entry.name!r} twice or out of order") from None
    return 1


def _copy(content: IO[bytes], file: IO[bytes], entry: tarfile.TarInfo) -> None:
    shutil.copyfileobj(content, file, _PIECE)
    if file.tell() != entry.size:
        raise TransferError(f"the archive ends within {entry.name!r}")


def _checked(entry: tarfile.TarInfo, directory: Path) -> PurePosixPath:
    """Return the path of an entry below the directory; raise `TransferError` if it is forbidden."""
    path = PurePosixPath(entry.name)
    if path.is_absolute() or ".." in path.parts or not path.parts:
        raise TransferError(f"the archive holds {entry.name!r}, which lies outside of it: refused")
    if entry.type not in (tarfile.REGTYPE, tarfile.DIRTYPE) or entry.issparse():
        raise TransferError(
            f"the archive holds {entry.name!r}, which is neither a file nor a directory: refused"
        )
    tarfile.data_filter(entry, os.fspath(directory))
    return path
