"""The regular files that processes hold open or have mapped, and which of them follow them."""

from __future__ import annotations

import os
import shutil
import stat
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Final, NamedTuple

from rosrm_criu.engine.image import COPIES, HeldFile, MappedFile

#: Bytes of the largest file that follows.
MOST: Final = 64 << 20

_DELETED: Final = " (deleted)"
#: What the kernel shows as files; its processes are others elsewhere.
_OF_THE_KERNEL: Final = ("/proc/", "/sys/")


class Descriptor(NamedTuple):
    """One open file of one process.

    Attributes:
        pid: whose it is.
        number: its number there.
        target: what /proc says that it is: a path, or `pipe:[4711]`.
        flags: that it was opened with.
    """

    pid: int
    number: int
    target: str
    flags: int

    @property
    def writes(self) -> bool:
        """It was opened for writing."""
        return self.flags & os.O_ACCMODE != os.O_RDONLY


def descriptors(pids: Iterable[int]) -> Iterator[Descriptor]:
    """All open files of some processes, standard output and error included."""
    for pid in pids:
        for number in _numbers(pid):
            try:
                target = os.readlink(f"/proc/{pid}/fd/{number}")  # noqa: PTH115 - may be no path
                flags = _flags(pid, number)
            except OSError:  # closed meanwhile
                continue
            yield Descriptor(pid, number, target, flags)


def _numbers(pid: int) -> list[int]:
    try:
        return sorted(map(int, os.listdir(f"/proc/{pid}/fd")))  # noqa: PTH208
    except OSError:  # it has ended, or belongs to somebody else
        return []


def _flags(pid: int, number: int) -> int:
    for line in Path(f"/proc/{pid}/fdinfo/{number}").read_text().splitlines():
        if line.startswith("flags:"):
            return int(line.split()[1], 8)
    return 0


def logs(root: int) -> tuple[str, ...]:
    """The files that are its standard output and error."""
    found = [one.target for one in descriptors([root]) if one.number in (1, 2)]
    return tuple(dict.fromkeys(path for path in found if _is_regular(root, path)))


def open_files(
    pids: Iterable[int], leave_out: Iterable[str], directory: str, image: Path
) -> tuple[HeldFile, ...]:
    """Note what they hold open, and copy what follows into an image; they must stand still.

    A file follows that one of them may write to and that lies below its working directory. Where
    that is the root directory, which holds everybody's files, none does.

    Args:
        pids: the processes.
        leave_out: paths that are no matter: the logs.
        directory: the working directory.
        image: its directory.
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
    """The name of the copy; "" for what is too large to follow."""
    if size > MOST:
        return ""
    name = f"{COPIES}/{number}"
    target = image / name
    target.parent.mkdir(mode=0o700, exist_ok=True)
    shutil.copyfile(_seen_by(one.pid, one.target), target)
    target.chmod(0o600)
    return name


def mapped_files(pids: Iterable[int]) -> tuple[MappedFile, ...]:
    """Programs, libraries and shared memory that they have mapped from files."""
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
    """A path that leads to a regular file for that process; not what was deleted."""
    if not path.startswith("/") or path.endswith(_DELETED):
        return False
    try:
        return stat.S_ISREG(_status(pid, path).st_mode)
    except OSError:
        return False


def _status(pid: int, path: str) -> os.stat_result:
    return _seen_by(pid, path).stat()


def _seen_by(pid: int, path: str) -> Path:
    """The path in the mount namespace of a process."""
    return Path(f"/proc/{pid}/root{path}")


def _lies_below(path: str, directory: str) -> bool:
    """Not of the root directory: all that a process writes anywhere lies below that one."""
    return directory != "/" and path.startswith(f"{directory}/")
