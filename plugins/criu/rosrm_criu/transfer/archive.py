"""A directory as one stream of bytes: a tar archive, then its checksum.

Two reads of an unchanged directory give the same bytes, so a broken stream can resume at any byte.
The archive holds only directories and regular files, with names and contents: no owners and no
times, and every mode is 0600 or 0700.
"""

from __future__ import annotations

import hashlib
import os
import stat
import tarfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from rosrm.errors import TransferError
from rosrm_criu.transfer.form import DIGEST_SIZE, new_digest

#: Bytes per read.
PIECE: Final = 1 << 18
#: Bytes between two saved states of the checksum: a resume reads at most this many bytes again,
#: which takes a fraction of a second.
MARK: Final = 64 << 20
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

    @property
    def length(self) -> int:
        return len(self.head()) + self.size + self.padding


@dataclass(frozen=True)
class _Mark:
    """The checksum of all bytes before a position in the archive."""

    position: int
    digest: hashlib.blake2b


class Archive:
    """A directory in its current state.

    Args:
        directory: may contain only directories and regular files.

    Attributes:
        size: bytes of all files.
        files: number of files.
        length: bytes of the archive, without the checksum.

    Raises:
        TransferError: it is missing, cannot be read, or contains something else.
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
        self.length = len(_END) + sum(entry.length for entry in self._entries)
        self._marks = [_Mark(0, new_digest())]

    def pieces(self, start: int = 0) -> Iterator[bytes]:
        """Yield the archive and its checksum, from a byte position on.

        At most `MARK` bytes before that position are read again, for the checksum.

        Raises:
            TransferError: a file has changed, or is gone.
        """
        self._marks = [mark for mark in self._marks if mark.position <= start]
        position, digest = self._marks[-1].position, self._marks[-1].digest.copy()
        for piece in self._archive(position):
            digest.update(piece)
            skip = max(0, start - position)
            position += len(piece)
            if position >= self._marks[-1].position + MARK:
                self._marks.append(_Mark(position, digest.copy()))
            if skip < len(piece):
                yield piece[skip:]
        assert position == self.length
        yield digest.digest()[max(0, start - position) : DIGEST_SIZE]

    def _archive(self, start: int) -> Iterator[bytes]:
        """Yield the archive without the checksum, from a byte position on."""
        for entry in self._entries:
            if start < entry.length:
                yield from self._entry(entry, max(0, start))
            start -= entry.length
        yield _END[max(0, start) :]

    def _entry(self, entry: _Entry, start: int) -> Iterator[bytes]:
        head = entry.head()
        yield head[start:]
        start -= len(head)
        if not entry.is_directory and start < max(1, entry.size):
            yield from self._content(entry, max(0, start))
        start -= entry.size
        yield bytes(entry.padding)[max(0, start) :]

    def _content(self, entry: _Entry, start: int) -> Iterator[bytes]:
        path = self._directory / entry.name
        try:
            descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NOFOLLOW)
            with os.fdopen(descriptor, "rb", buffering=0) as file:
                if os.fstat(descriptor).st_size != entry.size:
                    raise TransferError(f"{path} has changed since it was offered")
                left = entry.size - file.seek(start)
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
