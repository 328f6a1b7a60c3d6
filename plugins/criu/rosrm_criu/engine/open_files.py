"""Regular files that processes have open or mapped, and copies of those that follow the process."""

from __future__ import annotations

import os
import shutil
import stat
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Final, NamedTuple

from rosrm.shortage import raise_shortage
from rosrm_criu.engine.image import COPIES, HeldFile, MappedFile

#: Bytes of the largest file that follows the process.
MOST: Final = 64 << 20

_DELETED: Final = " (deleted)"
#: Files of the kernel; their contents differ between hosts.
_OF_THE_KERNEL: Final = ("/proc/", "/sys/")


class Descriptor(NamedTuple):
    """An open file of a process.

    Attributes:
        pid: the process.
        number: number of the descriptor in that process.
        target: link target in /proc: a path, or e.g. `pipe:[4711]`.
        flags: flags of open(2).
    """

    pid: int
    number: int
    target: str
    flags: int

    @property
    def writes(self) -> bool:
        """Return True if the file was opened for writing."""
        return self.flags & os.O_ACCMODE != os.O_RDONLY


def descriptors(pids: Iterable[int]) -> Iterator[Descriptor]:
    """Yield all open files of some processes, including standard output and error.

    Raises:
        OSError: no look is possible now.
    """
    for pid in pids:
        for number in _numbers(pid):
            try:
                target = os.readlink(f"/proc/{pid}/fd/{number}")  # noqa: PTH115 - may be no path
                flags = _flags(pid, number)
            except OSError as error:  # closed since the listing
                raise_shortage(error)
                continue
            yield Descriptor(pid, number, target, flags)


def _numbers(pid: int) -> list[int]:
    try:
        return sorted(map(int, os.listdir(f"/proc/{pid}/fd")))  # noqa: PTH208
    except OSError as error:  # the process has ended, or belongs to another user
        raise_shortage(error)
        return []


def _flags(pid: int, number: int) -> int:
    for line in Path(f"/proc/{pid}/fdinfo/{number}").read_text().splitlines():
        if line.startswith("flags:"):
            return int(line.split()[1], 8)
    return 0


def logs(root: int) -> tuple[str, ...]:
    """Return the regular files that are the standard output and error of a process."""
    found = [one.target for one in descriptors([root]) if one.number in (1, 2)]
    return tuple(dict.fromkeys(path for path in found if _is_regular(root, path)))


def open_files(
    pids: Iterable[int], leave_out: Iterable[str], directory: str, image: Path
) -> tuple[HeldFile, ...]:
    """List the open files of stopped processes, and copy those that follow into an image.

    A file follows the process if the process may write to it and it lies below the working
    directory. If the working directory is `/`, which holds everybody's files, none follows.

    Args:
        pids: the processes, which must be stopped.
        leave_out: paths to ignore: the logs.
        directory: the working directory.
        image: directory of the image.
    """
    found: dict[str, HeldFile] = {}
    copies = 0
    for one in descriptors(pids):
        known = found.get(one.target)
        if one.target in leave_out or one.target.startswith(_OF_THE_KERNEL):
            continue
        if not _is_regular(one.pid, one.target):
            continue
        status = _status(one.pid, one.target)
        grows = bool(one.flags & os.O_APPEND) and one.flags & os.O_ACCMODE == os.O_WRONLY
        copy = known.copy if known else ""
        if one.writes and not copy and _lies_below(one.target, directory):
            copy = _copy(one, status.st_size, image, copies)
            copies += bool(copy)
        found[one.target] = HeldFile(
            one.target, status.st_size, stat.S_IMODE(status.st_mode),
            grows and (known is None or known.grows), copy,
        )  # fmt: skip
    return tuple(found.values())


def _copy(one: Descriptor, size: int, image: Path, number: int) -> str:
    """Copy a file into the image and return the copy's name; "": it is too large to follow."""
    if size > MOST:
        return ""
    name = f"{COPIES}/{number}"
    target = image / name
    target.parent.mkdir(mode=0o700, exist_ok=True)
    shutil.copyfile(_seen_by(one.pid, one.target), target)
    target.chmod(0o600)
    return name


def mapped_files(pids: Iterable[int]) -> tuple[MappedFile, ...]:
    """Return the programs, libraries and shared-memory files that processes have mapped."""
    found: dict[str, MappedFile] = {}
    for pid in pids:
        for line in Path(f"/proc/{pid}/maps").read_text(errors="replace").splitlines():
            words = line.split(maxsplit=5)
            if len(words) == 6 and words[5].startswith("/") and words[5] not in found:
                path = words[5]
                if _is_regular(pid, path):
                    status = _status(pid, path)
                    mode = stat.S_IMODE(status.st_mode)
                    found[path] = MappedFile(path, status.st_size, mode)
    return tuple(found.values())


def _is_regular(pid: int, path: str) -> bool:
    """Return True if a path is a regular file for that process, and is not deleted."""
    if not path.startswith("/") or path.endswith(_DELETED):
        return False
    try:
        return stat.S_ISREG(_status(pid, path).st_mode)
    except OSError as error:
        raise_shortage(error)
        return False


def _status(pid: int, path: str) -> os.stat_result:
    return _seen_by(pid, path).stat()


def _seen_by(pid: int, path: str) -> Path:
    """Return a path that leads into the mount namespace of a process."""
    return Path(f"/proc/{pid}/root{path}")


def _lies_below(path: str, directory: str) -> bool:
    """Return True if a path lies below a directory other than `/`, below which every path lies."""
    return directory != "/" and path.startswith(f"{directory}/")
