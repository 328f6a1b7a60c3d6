"""A directory as one stream of bytes: a tar archive and its checksum, compressed by Zstandard.

The archive holds only directories and regular files, with names and contents: no owners and no
times, and every mode is 0600 or 0700. A received archive is not trusted: only directories and
regular files are written, only inside the target directory, and readable by their owner alone.
"""

from __future__ import annotations

import hmac
import os
import stat
import sys
import tarfile
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Final

from rosrm.errors import TransferError
from rosrm.wording import reason_of
from rosrm_criu.transfer.form import DIGEST_SIZE, new_digest

if sys.version_info >= (3, 14):
    from compression.zstd import ZstdCompressor, ZstdDecompressor, ZstdError
else:
    from backports.zstd import ZstdCompressor, ZstdDecompressor, ZstdError

#: Bytes per read.
_PIECE: Final = 1 << 18
#: The fastest regular level; a higher one is slower than a gigabit network.
_LEVEL: Final = 1
_END: Final = bytes(2 * tarfile.BLOCKSIZE)
#: Most bytes of the header with what a tar header has no room for, such as a long name.
_LARGEST_HEADER: Final = 1 << 16
#: Its fields that a sender writes.
_FIELDS: Final = frozenset({"path", "size", "hdrcharset"})
#: Most directories: the offer bounds the number of files alone.
_MOST_DIRECTORIES: Final = 1000
#: Most digits of a file's size.
_LONGEST_SIZE: Final = 18
_NEW: Final = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC


# --- sending ----------------------------------------------------------------------------------


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
        return -self.size % tarfile.BLOCKSIZE

    @property
    def length(self) -> int:
        return len(self.head()) + self.size + self.padding


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

    def compressed(self) -> Iterator[bytes]:
        """Yield the archive and its checksum as one Zstandard frame, in pieces of any size.

        Raises:
            TransferError: a file has changed, or is gone.
        """
        compressor = ZstdCompressor(level=_LEVEL)
        for piece in self.pieces():
            if packed := compressor.compress(piece):
                yield packed
        yield compressor.flush()

    def pieces(self) -> Iterator[bytes]:
        """Yield the archive and its checksum, uncompressed; raises as `compressed`."""
        digest = new_digest()
        for piece in self._archive():
            digest.update(piece)
            yield piece
        yield digest.digest()

    def _archive(self) -> Iterator[bytes]:
        for entry in self._entries:
            yield entry.head()
            if not entry.is_directory:
                yield from self._content(entry)
                yield bytes(entry.padding)
        yield _END

    def _content(self, entry: _Entry) -> Iterator[bytes]:
        path = self._directory / entry.name
        try:
            descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NOFOLLOW)
            with os.fdopen(descriptor, "rb", buffering=0) as file:
                if os.fstat(descriptor).st_size != entry.size:
                    raise TransferError(f"{path} has changed since it was offered")
                left = entry.size
                while left:
                    piece = file.read(min(_PIECE, left))
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
    return f"{path} cannot be read: {reason_of(error)}"


# --- receiving --------------------------------------------------------------------------------


class Unpacker:
    """Reader of a compressed archive, which checks its length, its entries and its checksum.

    Args:
        receive: returns the next compressed bytes, at least one; raises `TransferError`.
        length: bytes of the archive; no more are accepted.
        files: number of files; no more are accepted.

    Attributes:
        position: bytes of the archive that were read.
    """

    def __init__(self, receive: Callable[[], bytes], length: int, files: int) -> None:
        self._receive = receive
        self._length = length
        self._files = files
        self._decompressor = ZstdDecompressor()
        self._digest = new_digest()
        self.position = 0

    def unpack(self, directory: Path) -> None:
        """Write the archive into an empty directory.

        Raises:
            TransferError: it is no archive, is damaged, or contains something forbidden.
            OSError: something cannot be written.
        """
        files = directories = 0
        while entry := self._entry():
            directories += entry.is_directory
            files += not entry.is_directory
            if files > self._files or directories > _MOST_DIRECTORIES:
                raise TransferError(
                    f"the archive holds more than the {self._files} files that were offered, or "
                    f"more than {_MOST_DIRECTORIES} directories: refused"
                )
            self._write(entry, directory)
        while self._read(_PIECE):
            pass  # the checksum covers all bytes, also those after the end mark
        if files != self._files:
            raise TransferError(f"{files} files came, {self._files} were offered")

    def check(self) -> str:
        """Return the checksum of the archive in hexadecimal digits, after `unpack`.

        Raises:
            TransferError: the source sent a different checksum.
        """
        sent = b""
        while len(sent) < DIGEST_SIZE:
            sent += self._next(DIGEST_SIZE - len(sent))
        if not hmac.compare_digest(sent, self._digest.digest()):
            raise TransferError(
                "the received archive does not match its checksum: it was damaged, or changed "
                "while it was sent"
            )
        return sent.hex()

    def _entry(self) -> _Entry | None:
        """Return the next entry; None: the end mark was read. Raise `TransferError`."""
        header = self._header()
        fields: Mapping[str, str] = {}
        if header is not None and header.type == tarfile.XHDTYPE:
            fields = self._extended(header.size)
            header = self._header()
            if header is None:
                raise TransferError("the archive ends within the header of a file")
        return None if header is None else _checked(header, fields)

    def _header(self) -> tarfile.TarInfo | None:
        """Return the next header; None: the end mark was read. Raise `TransferError`."""
        block = self._exactly(tarfile.BLOCKSIZE)
        if not any(block):
            return None
        try:
            return tarfile.TarInfo.frombuf(block, "utf-8", "surrogateescape")
        except tarfile.TarError as error:
            raise TransferError(f"the received data is no sound archive: {error}") from None

    def _extended(self, size: int) -> Mapping[str, str]:
        """Return the fields of an extended header of so many bytes; raise `TransferError`."""
        if not 0 <= size <= _LARGEST_HEADER:
            raise TransferError(
                f"the archive holds a header of {size} bytes, allowed are {_LARGEST_HEADER}: "
                "refused"
            )
        return _fields(self._exactly(size + -size % tarfile.BLOCKSIZE)[:size])

    def _write(self, entry: _Entry, directory: Path) -> None:
        path = directory / entry.name
        try:
            if entry.is_directory:
                path.mkdir(mode=0o700)
                return
            descriptor = os.open(path, _NEW, 0o600)
        except (FileExistsError, FileNotFoundError, NotADirectoryError):
            raise TransferError(f"the archive names {entry.name!r} twice or out of order") from None
        with os.fdopen(descriptor, "wb", buffering=0) as file:
            left = entry.size
            while left:
                piece = self._read(min(_PIECE, left))
                if not piece:
                    raise TransferError(f"the archive ends within {entry.name!r}")
                left -= file.write(piece)
        self._exactly(entry.padding)

    def _exactly(self, size: int) -> bytes:
        """Return so many bytes of the archive; raise `TransferError` if it has less."""
        data = b""
        while len(data) < size:
            piece = self._read(size - len(data))
            if not piece:
                raise TransferError("the received data is no sound archive: it ends too soon")
            data += piece
        return data

    def _read(self, size: int) -> bytes:
        """Return at most `size` bytes of the archive; none at its end. Raise `TransferError`."""
        data = self._next(min(size, self._length - self.position))
        self.position += len(data)
        self._digest.update(data)
        return data

    def _next(self, size: int) -> bytes:
        """Return the next uncompressed bytes: at most `size`, and at least one if `size` is."""
        data = b""
        while size and not data:
            packed = self._receive() if self._decompressor.needs_input else b""
            try:
                data = self._decompressor.decompress(packed, size)
            except (ZstdError, EOFError) as error:
                raise TransferError(f"the received data is damaged: {error}") from None
        return data


def _fields(data: bytes) -> Mapping[str, str]:
    """Return the fields of an extended header, each preceded by its length; raise on others."""
    found: dict[str, str] = {}
    while data:
        digits, _, _ = data[:8].partition(b" ")
        size = int(digits) if digits.isdigit() else 0
        name, equals, value = data[len(digits) + 1 : size - 1].partition(b"=")
        field = name.decode("utf-8", "surrogateescape")
        if not equals or data[size - 1 : size] != b"\n" or field not in _FIELDS:
            raise TransferError("the received data is no sound archive: an extended header is none")
        found[field] = value.decode("utf-8", "surrogateescape")
        data = data[size:]
    return found


def _checked(header: tarfile.TarInfo, fields: Mapping[str, str]) -> _Entry:
    """Return the entry of a header; raise `TransferError` if it is forbidden."""
    name = fields.get("path", header.name).rstrip("/")
    path = PurePosixPath(name)
    if path.is_absolute() or ".." in path.parts or not path.parts or "\0" in name:
        raise TransferError(f"the archive holds {name!r}, which lies outside of it: refused")
    if header.type not in (tarfile.REGTYPE, tarfile.DIRTYPE):
        raise TransferError(
            f"the archive holds {name!r}, which is neither a file nor a directory: refused"
        )
    size = fields.get("size", str(header.size))
    if not (size.isascii() and size.isdigit() and len(size) <= _LONGEST_SIZE):
        raise TransferError(f"the archive holds {name!r} with a size of {size[:40]!r}: refused")
    return _Entry(name, int(size), is_directory=header.type == tarfile.DIRTYPE)
