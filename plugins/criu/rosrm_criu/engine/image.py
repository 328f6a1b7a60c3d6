"""Checkpoint image: a directory with everything that a restore needs, readable by its owner alone.

manifest.json     description (see `Manifest`); written last: without it the image is incomplete
criu/             CRIU's files; in `parent` memory that was sent before the dump
files/            copies of the files that follow the process
dump.log          CRIU's log of the dump; restore.log: of the restore
hold.json         the result of the restore (see `rosrm_criu.engine.shim`)
"""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import stat
import zlib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from rosrm.errors import CriuError
from rosrm.model.codec import from_plain, to_plain
from rosrm.shortage import is_file, tree
from rosrm.wording import reason_of

#: The format that is written. Only this one and its predecessor can be read.
FORMAT: Final = 2
#: The predecessor, whose manifest has no checksums, neither of the files nor of itself.
_WITHOUT_CHECKSUMS: Final = 1

MANIFEST: Final = "manifest.json"
PAGES: Final = "criu"
COPIES: Final = "files"
#: Below CRIU's files of an image: pages that were sent before the dump.
PARENT: Final = f"{PAGES}/parent"
#: The parent of these, if pages were sent twice: those of the first time.
GRANDPARENT: Final = f"{PARENT}/parent"
#: Exists during a restore: like `PAGES`, with the paths of this host.
HERE: Final = f"{PAGES}.here"
DUMP_LOG: Final = "dump.log"
RESTORE_LOG: Final = "restore.log"

#: Bytes to keep free on the file system of an image.
_SPARE: Final = 16 << 20
#: Bytes per read while a file's checksum is computed.
_PIECE: Final = 1 << 20


@dataclass(frozen=True)
class HeldFile:
    """A regular file that the process has open.

    Args:
        path: absolute, as the process knows it.
        size: bytes at the time of the dump.
        mode: its permissions.
        grows: the process only appends to it. So its size may differ at the restore, and it is
            created if it is missing.
        copy: path of its copy below the image, which the restore puts back; "": the file must
            exist at the restore.
    """

    path: str
    size: int
    mode: int
    grows: bool
    copy: str


@dataclass(frozen=True)
class MappedFile:
    """A program, library or shared-memory file that the process has mapped.

    Args:
        path: absolute.
        size: bytes.
        mode: its permissions.
    """

    path: str
    size: int
    mode: int


@dataclass(frozen=True)
class Manifest:
    """Description of an image and of the requirements for its restore.

    Args:
        process: name of the process.
        instance: number of the instance that was dumped.
        host: network name of the host of the dump.
        made_at: seconds since 1970.
        criu: version of the CRIU that dumped it.
        kernel: release of the kernel.
        machine: "x86_64", ...
        pid: of the root process, in its own pid namespace.
        ids: of all processes and threads, in the same namespace.
        logs: files that were its standard output and error.
        working_directory: of the root process.
        shelter: the supervisor's default working directory; "": unknown.
        interpreter: the program that the root process runs.
        files: open files.
        mapped: mapped files.
        sizes: bytes of each file below the image except the manifest.
        checksums: CRC-32 of each of these files; empty: none were computed.
    """

    process: str
    instance: int
    host: str
    made_at: float
    criu: str
    kernel: str
    machine: str
    pid: int
    ids: tuple[int, ...]
    logs: tuple[str, ...]
    working_directory: str
    shelter: str
    interpreter: str
    files: tuple[HeldFile, ...] = ()
    mapped: tuple[MappedFile, ...] = ()
    sizes: Mapping[str, int] = field(default_factory=dict)
    checksums: Mapping[str, int] = field(default_factory=dict)

    @property
    def size(self) -> int:
        """Return the bytes of the image, without the manifest."""
        return sum(self.sizes.values())


def create(directory: Path) -> None:
    """Create an empty image; raise CriuError if it cannot be created or the directory has files."""
    try:
        directory.mkdir(mode=0o700, parents=True, exist_ok=True)
        directory.chmod(0o700)
        if any(directory.iterdir()):
            raise CriuError(f"the image directory {directory} is not empty")
        (directory / PAGES).mkdir(mode=0o700)
    except OSError as error:
        raise CriuError(f"no image can be made in {directory}: {reason_of(error)}") from None


def link_or_copy(source: str | Path, target: str | Path) -> None:
    """Make a hard link to a file, or a copy on a file system without hard links."""
    try:
        os.link(source, target)
    except OSError:
        shutil.copy2(source, target)


def check_room(directory: Path, needed: int) -> None:
    """Raise CriuError if there is no room for an image of so many bytes."""
    free = shutil.disk_usage(directory).free
    if free < needed + _SPARE:
        raise CriuError(
            f"there is no room for the image in {directory}: it takes about {needed >> 20} MiB, "
            f"{free >> 20} MiB are free (at least {_SPARE >> 20} MiB shall stay free)"
        )


def file_sizes(directory: Path) -> dict[str, int]:
    """Return the bytes of each file of an image by relative path; set each mode to 0600."""
    sizes = {}
    for path in sorted(map(Path, tree(directory))):
        name = path.relative_to(directory).as_posix()
        if is_file(path) and name.startswith((f"{PAGES}/", f"{COPIES}/")):
            path.chmod(0o600)
            sizes[name] = path.stat().st_size
    return sizes


def file_checksums(directory: Path, names: Iterable[str]) -> dict[str, int]:
    """Return the CRC-32 of files of an image, by relative path; raise OSError."""
    return {name: _checksum_of_file(directory / name) for name in names}


def _checksum_of_file(path: Path) -> int:
    checksum, piece = 0, memoryview(bytearray(_PIECE))
    with path.open("rb", buffering=0) as file:
        while count := file.readinto(piece):
            checksum = zlib.crc32(piece[:count], checksum)
    return checksum


def write(directory: Path, manifest: Manifest) -> None:
    """Write the manifest, which makes the image complete."""
    values = to_plain(manifest)
    own = _checksum_of_values(values)
    text = json.dumps({"format": FORMAT, "checksum": own, **values}, indent=1)
    new = directory / f"{MANIFEST}.new"
    new.touch(mode=0o600)
    new.write_text(text, encoding="utf-8")
    new.replace(directory / MANIFEST)


def read(directory: Path) -> Manifest:
    """Return the manifest of an image, after a check that all files exist with their sizes.

    Raises:
        CriuError: it is no image, is incomplete or damaged, has another format, or is of another
            user or open to others.
    """
    try:
        _check_private(directory, stat.S_IFDIR)
        _check_private(directory / MANIFEST, stat.S_IFREG)
        text = (directory / MANIFEST).read_text(encoding="utf-8")
    except FileNotFoundError:
        raise CriuError(f"{directory} holds no complete image: there is no {MANIFEST}") from None
    except (OSError, UnicodeDecodeError) as error:
        raise CriuError(f"{directory / MANIFEST} cannot be read: {error}") from None
    try:
        values = json.loads(text)
        written = values.pop("format", None)
        known = written in (FORMAT, _WITHOUT_CHECKSUMS)
        manifest = _manifest(_whole(values, written)) if known else None
    except KeyError as error:
        raise CriuError(f"the image {directory} is damaged: {MANIFEST}: no {error}") from None
    except (ValueError, TypeError, AttributeError, RecursionError) as error:
        raise CriuError(f"the image {directory} is damaged: {MANIFEST}: {error}") from None
    if manifest is None:
        raise CriuError(
            f"the image {directory} has format {written!r}; this rosrm reads format {FORMAT}"
        )
    _check_files(directory, manifest)
    return manifest


def _check_private(path: Path, kind: int) -> os.stat_result:
    """Return the status of a file or directory of an image; raise OSError.

    Raises:
        CriuError: the path is of another kind, of another user, or open to others.
    """
    found = path.lstat()
    if stat.S_IFMT(found.st_mode) != kind or found.st_uid not in (0, os.geteuid()):
        raise CriuError(f"{path} is a link, or belongs to another user: the image is refused")
    if found.st_mode & 0o077:
        mode = "0700" if kind == stat.S_IFDIR else "0600"
        raise CriuError(
            f"the image is refused: {path} is open to others: its mode has to be {mode}"
        )
    return found


def _check_files(directory: Path, manifest: Manifest) -> None:
    for folder in {name.split("/")[0] for name in manifest.sizes if "/" in name}:
        with contextlib.suppress(FileNotFoundError):  # the missing file is named below
            _check_private(directory / folder, stat.S_IFDIR)
    for name, size in manifest.sizes.items():
        try:
            found = _check_private(directory / name, stat.S_IFREG).st_size
        except OSError as error:
            raise _damaged(directory, manifest, f"{name}: {reason_of(error)}") from None
        if found != size:
            what = f"{name} has {found} bytes instead of {size}"
            raise _damaged(directory, manifest, what)


def check_contents(directory: Path, manifest: Manifest) -> None:
    """Compare each file with its checksum, if the manifest has any; this reads the whole image.

    Args:
        directory: of the image.
        manifest: of the image, as `read` returns it.

    Raises:
        CriuError: a file has changed or cannot be read; the message names it.
    """
    for name, checksum in manifest.checksums.items():
        try:
            found = _checksum_of_file(directory / name)
        except OSError as error:
            raise _damaged(directory, manifest, f"{name}: {reason_of(error)}") from None
        if found != checksum:
            sums = f"CRC-32 {found:08x} instead of {checksum:08x}"
            what = f"{name} has changed since it was written ({sums})"
            raise _damaged(directory, manifest, what)


def _damaged(directory: Path, manifest: Manifest, what: str) -> CriuError:
    """Return the error, with advice unless the process of the image still exists (no checksums)."""
    advice = (
        f". Its memory is lost: `rosrm restart {manifest.process or 'NAME'}` starts the process "
        f"without it"
    )
    return CriuError(
        f"the image {directory} is damaged: {what}{advice if manifest.checksums else ''}"
    )


def remove(directory: Path, *, logs: bool = True) -> None:
    """Remove the contents of an image, except the directory and the result of its restore.

    Args:
        directory: of the image.
        logs: remove CRIU's logs too.
    """
    for name in (MANIFEST, f"{MANIFEST}.new", *((DUMP_LOG, RESTORE_LOG) if logs else ())):
        (directory / name).unlink(missing_ok=True)
    for name in (PAGES, COPIES, HERE):
        shutil.rmtree(directory / name, ignore_errors=True)


# --- reading strictly ---------------------------------------------------------------------------


def _whole(values: dict[str, Any], written: int) -> dict[str, Any]:
    """Return the manifest's values after a check of its checksum, which the old format lacks."""
    if written == _WITHOUT_CHECKSUMS:
        return {**values, "checksums": {}}
    own = values.pop("checksum")
    if own != _checksum_of_values(values):
        raise ValueError("it has changed since it was written")
    return values


def _checksum_of_values(values: dict[str, Any]) -> int:
    """Return a checksum of values, the same before writing and after reading."""
    return zlib.crc32(json.dumps(values, sort_keys=True).encode())


def _manifest(values: dict[str, Any]) -> Manifest:
    manifest = from_plain(Manifest, values)
    for name in (*manifest.sizes, *manifest.checksums, *(one.copy for one in manifest.files)):
        if name.startswith("/") or ".." in name.split("/"):
            raise ValueError(f"{name!r} does not lie in the image")
    return manifest
