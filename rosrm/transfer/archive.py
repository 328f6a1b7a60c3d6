"""Reads a directory as one stream of bytes: a tar archive, then its checksum.

Two readings of an unchanged directory give the same bytes, so a stream that broke can be gone on
with from any byte. It holds directories and regular files, and of these their names and contents
alone: neither owners nor times, and every mode is 0600 or 0700.
"""

from __future__ import annotations

import os
import stat
import tarfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from rosrm.errors import TransferError
from rosrm.transfer.form import DIGEST_SIZE, new_digest

#: Bytes that are read at a time.
PIECE: Final = 1 << 18
_BLOCK: Final = tarfile.BLOCKSIZE
_END: Final = bytes(2 * _BLOCK)


@dataclass(frozen=True)
class _Entry:
    name: str
    size: int
    is_directory: bool

    def head(self) -> bytes:
        entry = tarfile.TarInfo(self.name)
        entry.type = tarfile.DIRTYPE if self.is_directory else tarfile.REGTYPE
        entry.mode = 0o700 if self.is_directory else 0o600
        entry.size = self.size
        return entry.tobuf(tarfile.PAX_FORMAT, "utf-8", "surrogateescape")

    @property
    def padding(self) -> int:
        return -self.size % _BLOCK


class Archive:
    """A directory as it is now.

    Args:
        directory: it and all that is in it must be directories and regular files.

    Attributes:
        size: bytes of all files.
        files: how many there are.
        length: bytes of the archive, without the checksum.

    Raises:
        TransferError: it is not there, cannot be read, or holds something else.
    """

    def __init__(self, directory: Path) -> None:
        self._directory = directory
        try:
            self._entries = list(_entries(directory, ""))
        except OSError as error:
            raise TransferError(_unreadable(Path(error.filename or directory), error)) from None
        files = [entry for entry in self._entries if not entry.is_directory]
        self.size = sum(entry.size for entry in files)
        self.files = len(files)
        self.length = len(_END) + sum(
            len(entry.head()) + entry.size + entry.padding for entry in self._entries
        )

    def pieces(self, start: int = 0) -> Iterator[bytes]:
        """Archive and checksum from a byte on; what comes before is read all the same, for it.

        Raises:
            TransferError: a file has changed, or is gone.
        """
        digest = new_digest()
        position = 0
        for piece in self._archive():
            digest.update(piece)
            skip = max(0, start - position)
            position += len(piece)
            if skip < len(piece):
                yield piece[skip:]
        assert position == self.length
        yield digest.digest()[max(0, start - position) : DIGEST_SIZE]

    def _archive(self) -> Iterator[bytes]:
        for entry in self._entries:
            yield entry.head()
            if not entry.is_directory:
                yield from self._content(entry)
                if entry.padding:
                    yield bytes(entry.padding)
        yield _END

    def _content(self, entry: _Entry) -> Iterator[bytes]:
        path = self._directory / entry.name
        try:
            descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NOFOLLOW)
            with os.fdopen(descriptor, "rb", buffering=0) as file:
                left = entry.size
                if os.fstat(descriptor).st_size != left:
                    raise TransferError(f"{path} has changed since it was offered")
                while left:
                    piece = file.read(min(PIECE, left))
                    if not piece:
                        raise TransferError(f"{path} has changed while it was sent")
                    left -= len(piece)
                    yield piece
        except OSError as error:
            raise TransferError(_unreadable(path, error)) from None


def _entries(directory: Path, before: str) -> Iterator[_Entry]:
    for path in sorted(directory.iterdir()):
        status = path.lstat()
        name = before + path.name
        if stat.S_ISDIR(status.st_mode):
            yield _Entry(name, 0, is_directory=True)
            yield from _entries(path, f"{name}/")
        elif stat.S_ISREG(status.st_mode):
            yield _Entry(name, status.st_size, is_directory=False)
        else:
            raise TransferError(f"{path} is neither a file nor a directory: it cannot be moved")


def _unreadable(path: Path, error: OSError) -> str:
    if isinstance(error, FileNotFoundError):
        return f"{path} is gone, or was never there"
    return f"{path} cannot be read: {error.strerror}"
