"""A file or directory as an archive: the same bytes for the same names, modes and contents.

The archive is a tar without owners and times. Of the modes only the right to execute is kept.
"""

from __future__ import annotations

import os
import stat
import tarfile
from collections.abc import Iterator
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path
from typing import Final

from rosrm.artifacts.unpack import CONTENT, MOST_ENTRIES, link_fault
from rosrm.errors import ConfigError, Refused
from rosrm.model.artifacts import name_fault
from rosrm.wording import reason_of

#: Bytes per read.
_PIECE: Final = 1 << 18
_END: Final = bytes(2 * tarfile.BLOCKSIZE)
#: Directories that are left out: a run of the program on the submitting machine changes them.
_LEFT_OUT: Final = ("__pycache__",)


def source_fault(source: str | Path) -> str:
    """Return why a path cannot be an artifact, without reading its contents; "" if it can."""
    path = Path(source)
    try:
        mode = path.stat().st_mode
    except FileNotFoundError:
        return f"{path}: there is no such file or directory"
    except (OSError, ValueError) as error:
        return f"{path}: {reason_of(error)}"
    if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):
        return f"{path}: neither a file nor a directory"
    rights = os.R_OK if stat.S_ISREG(mode) else os.R_OK | os.X_OK
    return "" if os.access(path, rights) else f"{path}: this user may not read it"


@dataclass(frozen=True, slots=True)
class _Entry:
    """An entry of the archive: a file, a directory (a size of 0), or a link to `target`."""

    name: str
    path: Path
    mode: int
    size: int = 0
    target: str = ""

    def head(self) -> bytes:
        """Return the header of the entry in the archive."""
        entry = tarfile.TarInfo(self.name)
        entry.mode = 0o755 if self.is_directory or self.mode & stat.S_IXUSR else 0o644
        entry.size, entry.linkname = self.size, self.target
        if self.target:
            entry.type, entry.mode = tarfile.SYMTYPE, 0o777
        elif self.is_directory:
            entry.type = tarfile.DIRTYPE
        return entry.tobuf(tarfile.PAX_FORMAT, "utf-8", "surrogateescape")

    @property
    def is_directory(self) -> bool:
        """Return True for a directory."""
        return stat.S_ISDIR(self.mode)


class Archive:
    """A file or directory in its current state, as an archive that is read in parts.

    Args:
        source: a link here is followed; links inside must stay inside.

    Attributes:
        digest: SHA-256 of the archive in hexadecimal digits.
        size: bytes of the archive.

    Raises:
        ConfigError: a part of it cannot be read, or cannot be in an artifact.
    """

    def __init__(self, source: str | Path) -> None:
        fault = source_fault(source)
        if fault:
            raise ConfigError(fault)
        self._source = Path(source).resolve()
        try:
            self._entries = list(_entries(self._source))
        except OSError as error:
            raise ConfigError(f"{error.filename or source}: {reason_of(error)}") from None
        digest, self.size = sha256(), 0
        for piece in self._pieces():
            digest.update(piece)
            self.size += len(piece)
        self.digest = digest.hexdigest()
        self._open: Iterator[bytes] = iter(())
        self._rest, self._position = b"", self.size

    def part(self, offset: int, most: int) -> bytes:
        """Return at most `most` bytes of the archive from `offset` on; reads ahead in order.

        Raises:
            Refused: a file has changed since its digest was computed.
            ConfigError: a file cannot be read.
        """
        if offset < self._position:
            self._open, self._rest, self._position = self._pieces(), b"", 0
        self._skip_to(offset)
        while len(self._rest) < most and (piece := next(self._open, b"")):
            self._rest += piece
            self._skip_to(offset)
        return self._rest[:most]

    def _skip_to(self, offset: int) -> None:
        skipped = min(offset - self._position, len(self._rest))
        self._rest, self._position = self._rest[skipped:], self._position + skipped

    def _pieces(self) -> Iterator[bytes]:
        for entry in self._entries:
            yield entry.head()
            if entry.size:
                yield from _content(entry)
                if padding := -entry.size % tarfile.BLOCKSIZE:
                    yield bytes(padding)
        yield _END


def changed(source: str | Path) -> Refused:
    """Return the refusal of contents that differ from their digest."""
    return Refused(
        f"{source} changed while it was sent: run the command again once no program writes to it. "
        f"Nothing was changed",
        "changed",
    )


def _content(entry: _Entry) -> Iterator[bytes]:
    try:
        descriptor = os.open(entry.path, os.O_RDONLY | os.O_CLOEXEC | os.O_NOFOLLOW)
        with os.fdopen(descriptor, "rb", buffering=0) as file:
            left = entry.size
            if os.fstat(descriptor).st_size != left:
                raise changed(entry.path)
            while left:
                piece = file.read(min(_PIECE, left))
                if not piece:
                    raise changed(entry.path)
                left -= len(piece)
                yield piece
    except FileNotFoundError:
        raise changed(entry.path) from None
    except OSError as error:
        raise ConfigError(f"{entry.path}: {reason_of(error)}") from None


def _entries(source: Path) -> Iterator[_Entry]:
    status = source.stat()
    if not stat.S_ISDIR(status.st_mode):
        yield _Entry(CONTENT, source, status.st_mode, status.st_size)
        return
    yield _Entry(CONTENT, source, status.st_mode)
    for count, entry in enumerate(_below(source, source, ""), 2):
        if count > MOST_ENTRIES:
            raise ConfigError(
                f"{source}: more than {MOST_ENTRIES} files and directories; pack them into one file"
            )
        yield entry


def _below(root: Path, directory: Path, before: str) -> Iterator[_Entry]:
    for path in sorted(directory.iterdir()):
        status, name = path.lstat(), before + path.name
        fault = name_fault(name)
        if fault:
            raise ConfigError(f"{root}: {fault}")
        whole = f"{CONTENT}/{name}"
        if stat.S_ISDIR(status.st_mode):
            if path.name not in _LEFT_OUT:
                yield _Entry(whole, path, status.st_mode)
                yield from _below(root, path, f"{name}/")
        elif stat.S_ISREG(status.st_mode):
            yield _Entry(whole, path, status.st_mode, status.st_size)
        elif stat.S_ISLNK(status.st_mode):
            yield _Entry(whole, path, status.st_mode, target=_target(root, path, name))
        else:
            raise ConfigError(
                f"{path}: neither a file, a directory nor a link; devices, sockets and pipes "
                "cannot be in an artifact"
            )


def _target(root: Path, path: Path, name: str) -> str:
    """Return the target of a link; raise `ConfigError` if the link leaves the directory."""
    target = str(path.readlink())
    fault = link_fault(name, target)
    if not fault and not path.resolve().is_relative_to(root):
        fault = f"{target!r} lies outside of the directory"
    if fault:
        raise ConfigError(f"{path}: a link in an artifact must stay in its directory: {fault}")
    return target
