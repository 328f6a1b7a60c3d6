"""Public. Distinction between a missing file or process and an error in the search for it.

Code that treated any error as absence ended a running process, or deleted the only copy of a state.

`os.path.exists` and similar functions return False or nothing after any error; from Python 3.14 on,
so do those of `pathlib`, and its `glob`. The functions here do so only for a file that certainly
does not exist.
"""

from __future__ import annotations

import errno
import os
import stat
from collections.abc import Iterator
from typing import Final

__all__ = [
    "ABSENT", "SHORTAGE", "exists", "is_directory", "is_file", "names", "raise_shortage",
    "raise_unless_absent", "status", "tree",
]  # fmt: skip

#: No room for another open file, or no memory.
SHORTAGE: Final = frozenset({errno.EMFILE, errno.ENFILE, errno.ENOMEM})
#: Errors for a path that does not exist, and for a device file without a device.
ABSENT: Final = frozenset({errno.ENOENT, errno.ENOTDIR, errno.ELOOP, errno.ENODEV, errno.ENXIO})


def raise_shortage(error: OSError) -> None:
    """Raise an error that is a shortage; any other one tells something about the file."""
    if error.errno in SHORTAGE:
        raise error


def raise_unless_absent(error: OSError) -> None:
    """Raise an error again unless it means that a file, or a process in /proc, does not exist."""
    if error.errno not in (*ABSENT, errno.ESRCH):
        raise error


def status(path: str | os.PathLike[str], *, follow_symlinks: bool = True) -> os.stat_result | None:
    """Return the status of a file; None: it does not exist.

    Raises:
        OSError: the file may exist, but cannot be looked at now.
    """
    try:
        return os.stat(path, follow_symlinks=follow_symlinks)  # noqa: PTH116 - without pathlib
    except OSError as error:
        if error.errno in ABSENT:
            return None
        raise
    except ValueError:  # a NUL byte in the path, or a character that has no bytes
        return None


def exists(path: str | os.PathLike[str]) -> bool:
    """Return True if a file of any kind exists; raises `OSError` as `status`."""
    return status(path) is not None


def is_directory(path: str | os.PathLike[str]) -> bool:
    """Return True for a directory, or a link to one; raises `OSError` as `status`."""
    found = status(path)
    return found is not None and stat.S_ISDIR(found.st_mode)


def is_file(path: str | os.PathLike[str]) -> bool:
    """Return True for a regular file, or a link to one; raises `OSError` as `status`."""
    found = status(path)
    return found is not None and stat.S_ISREG(found.st_mode)


def names(directory: str | os.PathLike[str]) -> list[str]:
    """Return the names in a directory, in any order; [] if it does not exist.

    Raises:
        OSError: it may exist, but cannot be listed now.
    """
    try:
        return os.listdir(directory)  # noqa: PTH208 - as above
    except OSError as error:
        raise_unless_absent(error)
        return []


def tree(directory: str | os.PathLike[str]) -> Iterator[str]:
    """Yield the paths of all files and directories below a directory, without following links.

    Raises `OSError` as `names`.
    """
    for name in names(directory):
        path = f"{os.fspath(directory)}/{name}"
        yield path
        found = status(path, follow_symlinks=False)
        if found is not None and stat.S_ISDIR(found.st_mode):
            yield from tree(path)
