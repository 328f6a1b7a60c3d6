"""A directory as one stream of bytes: a tar archive and its checksum, compressed by Zstandard.

The archive holds only directories and regular files, with names and contents: no owners and no
times, and every mode is 0600 or 0700. A received archive is not trusted: only directories and
regular files are written, only inside the target directory, and readable by their owner alone.
"""

from __future__ import annotations

import hmac
import os
import shutil
import stat
import sys
import tarfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import IO, Any, Final

from rosrm.errors import TransferError
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
    return f"{path} cannot be read: {error.strerror}"


# --- receiving --------------------------------------------------------------------------------


class Unpacker:
    """Reader of a compressed archive, which checks its length and its checksum.

    Args:
        receive: returns the next compressed bytes, at least one; raises `TransferError`.
        length: bytes of the archive; no more are accepted.

    Attributes:
        position: bytes of the archive that were read.
    """

    def __init__(self, receive: Callable[[], bytes], length: int) -> None:
        self._receive = receive
        self._length = length
        self._decompressor = ZstdDecompressor()
        self._digest = new_digest()
        self.position = 0

    def unpack(self, directory: Path) -> int:
        """Write the archive into an empty directory; return the number of files.

        Raises:
            TransferError: it is no archive, is damaged, or contains something forbidden.
            OSError: something cannot be written.
        """
        files = 0
        try:
            # tarfile calls only read(size).
            source: Any = self
            with tarfile.open(fileobj=source, mode="r|", bufsize=_PIECE) as tar:
                for entry in tar:
                    files += _write(tar, entry, directory)
            while self.read(_PIECE):
                pass  # tarfile stops at the archive's end mark, but the checksum covers all bytes
        except (tarfile.TarError, EOFError) as error:
            raise TransferError(f"the received data is no sound archive: {error}") from None
        return files

    def read(self, size: int, /) -> bytes:
        """Return at most `size` bytes of the archive; none at its end. Raise `TransferError`."""
        data = self._next(min(size, self._length - self.position))
        self.position += len(data)
        self._digest.update(data)
        return data

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
