"""Files that a restore creates or replaces, with paths and modes that the manifest names.

The manifest of an image from another host is as trustworthy as that host. So a file that follows
the process is written below its working directory alone, no symbolic link on the way is followed,
and no file gets more than the permissions `rwxrwxrwx`. Standard library only.
"""

from __future__ import annotations

import contextlib
import errno
import os
import platform
import re
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Final

from rosrm.errors import CriuError
from rosrm.shortage import exists
from rosrm.wording import reason_of
from rosrm_criu.engine import image
from rosrm_criu.engine.image import HeldFile, Manifest, MappedFile

#: Permissions that a file may get: no set-user-ID, no set-group-ID, not sticky.
_PERMISSIONS: Final = 0o777
#: LTTng's files, which every ROS process maps: without content, and made by its first user.
_TRACING: Final = re.compile(r"/dev/shm/lttng-ust-wait-[\w.-]+", re.ASCII)  # noqa: S108
#: Most bytes of such a file; LTTng's have one page.
_MOST_TRACED: Final = 1 << 20

_DIRECTORY: Final = os.O_DIRECTORY | os.O_CLOEXEC
_NEW: Final = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC


def is_tracing(path: str) -> bool:
    """Return True if a path is that of a file of LTTng, which a restore creates where it lacks."""
    return _TRACING.fullmatch(path) is not None


def parts_below(path: str, directory: str) -> tuple[str, ...]:
    """Return the names that lead from a directory to a path below it.

    Args:
        path: absolute, without ".." and other detours.
        directory: likewise.

    Raises:
        CriuError: the path does not lie below the directory.
    """
    before = directory.rstrip("/") + "/"
    parts = tuple(path[len(before) :].split("/"))
    strange = {"", ".", ".."} & set(parts) or "\0" in path
    if not path.startswith(before) or strange:
        raise CriuError(f"the file {path!r} of the image does not lie below {directory}: refused")
    return parts


def prepare(directory: Path, manifest: Manifest) -> None:
    """Put back the files that follow the process; create missing append-only and LTTng files.

    The checksums of the whole image are compared before the first change. Otherwise a damaged file
    could replace an intact one, and CRIU would restore damaged memory without an error.

    Args:
        directory: of the image.
        manifest: of the image, with the paths of this host.

    Raises:
        CriuError: the image is damaged, or a file cannot be put back.
    """
    image.check_contents(directory, manifest)
    for mapped in manifest.mapped:
        if is_tracing(mapped.path) and not exists(mapped.path):
            _make_tracing_file(mapped)
    for held in manifest.files:
        try:
            _put_back(directory, held, manifest.working_directory)
        except OSError as error:
            raise CriuError(
                f"the file {held.path}, which the process has open, cannot be put back on "
                f"{platform.node()}: {_why(error)}"
            ) from None


def _why(error: OSError) -> str:
    if error.errno in (errno.ELOOP, errno.ENOTDIR):
        return "on its way is a symbolic link, which is not followed, or no directory"
    return reason_of(error)


def _put_back(directory: Path, held: HeldFile, working_directory: str) -> None:
    if held.copy:
        parts = parts_below(held.path, working_directory)
        with _folder(working_directory, parts[:-1]) as folder:
            _replace(directory / held.copy, folder, parts[-1], held.mode)
    elif held.grows and not exists(held.path):
        parts = parts_below(held.path, "/")
        with _folder("/", parts[:-1]) as folder:
            os.close(os.open(parts[-1], _NEW, held.mode & _PERMISSIONS, dir_fd=folder))


@contextlib.contextmanager
def _folder(start: str, names: tuple[str, ...]) -> Iterator[int]:
    """Yield a descriptor of a folder below `start`, and create what is missing; raise OSError.

    The path `start` may contain links; the names from there to the folder may not.
    """
    with contextlib.ExitStack() as way:
        here = os.open(start, os.O_PATH | _DIRECTORY)
        way.callback(os.close, here)
        for name in names:
            with contextlib.suppress(FileExistsError):
                os.mkdir(name, dir_fd=here)
            here = os.open(name, os.O_PATH | os.O_NOFOLLOW | _DIRECTORY, dir_fd=here)
            way.callback(os.close, here)
        yield here


def _replace(source: Path, folder: int, name: str, mode: int) -> None:
    """Replace a file by a copy with the same owner.

    Args:
        source: the copy.
        folder: descriptor of the folder of the file.
        name: of the file.
        mode: of the file.
    """
    new = f".{name}.rosrm"
    with contextlib.suppress(FileNotFoundError):
        os.unlink(new, dir_fd=folder)
    descriptor = os.open(new, _NEW, 0o600, dir_fd=folder)
    try:
        with source.open("rb") as copy, os.fdopen(descriptor, "wb") as file:
            shutil.copyfileobj(copy, file)
            if os.geteuid() == 0:
                before = _status(folder, name)
                os.fchown(descriptor, before.st_uid, before.st_gid)
            os.fchmod(descriptor, mode & _PERMISSIONS)
        os.rename(new, name, src_dir_fd=folder, dst_dir_fd=folder)
    except OSError:
        os.unlink(new, dir_fd=folder)
        raise


def _status(folder: int, name: str) -> os.stat_result:
    """Return the status of a file, or of its folder where the file is missing."""
    try:
        return os.stat(name, dir_fd=folder, follow_symlinks=False)
    except FileNotFoundError:
        return os.fstat(folder)


def _make_tracing_file(mapped: MappedFile) -> None:
    if not 0 <= mapped.size <= _MOST_TRACED:
        raise CriuError(f"{mapped.path} of {mapped.size} bytes is no file of LTTng: refused")
    new = f"{mapped.path}.{os.getpid()}"
    descriptor = os.open(new, os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600)
    try:
        os.ftruncate(descriptor, mapped.size)
        os.fchmod(descriptor, mapped.mode & _PERMISSIONS)
        os.link(new, mapped.path)  # unlike rename, this keeps a file that appeared since the check
    except FileExistsError:
        pass
    finally:
        os.close(descriptor)
        os.unlink(new)  # noqa: PTH108
