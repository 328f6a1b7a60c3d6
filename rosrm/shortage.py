"""Errors that tell what the machine or this process lacks now, not what a file or process is.

Code that took one of them for "it does not exist" ended a process that runs, or deleted the only
copy of a state.

`os.path.exists` and its kin, and from Python 3.14 on those of `pathlib`, are False after any error.
The functions here are False only for what certainly does not exist.
"""

from __future__ import annotations

import errno
import os
import stat
from typing import Final

#: No room for another open file, or no memory.
SHORTAGE: Final = frozenset({errno.EMFILE, errno.ENFILE, errno.ENOMEM})
#: Nothing has this path.
_ABSENT: Final = frozenset({errno.ENOENT, errno.ENOTDIR, errno.ELOOP})


def raise_shortage(error: OSError) -> None:
    """Raise an error that is a shortage; any other one tells something about the file."""
    if error.errno in SHORTAGE:
        raise error


def status(path: str | os.PathLike[str], *, follow_symlinks: bool = True) -> os.stat_result | None:
    """Return the status of a file; None: it does not exist.

    Raises:
        OSError: the file may exist, but cannot be looked at now.
    """
    try:
        return os.stat(path, follow_symlinks=follow_symlinks)  # noqa: PTH116 - without pathlib
    except OSError as error:
        if error.errno in _ABSENT:
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
