"""Watch of the disk of the state directory: full, read-only, failing, or without an answer."""

from __future__ import annotations

import errno
import os
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Final

from rosrm.runtime.path_calls import PathCalls, at

#: Seconds between two looks.
PERIOD: Final = 5.0
#: Bytes that must fit on the disk: a few lines of each file of a slave and its supervisor.
ROOM: Final = 1 << 16
#: Errors of a file system that has no files without a name, so nothing is tried there.
_NO_NAMELESS: Final = (errno.EOPNOTSUPP, errno.EISDIR, errno.EINVAL, errno.ENOENT)


def fault_of(directory: Path) -> str:
    """Return why nothing can be written to a directory's disk; "": it can."""
    at(directory)
    try:
        file = os.open(directory, os.O_TMPFILE | os.O_WRONLY | os.O_CLOEXEC, 0o600)
    except OSError as error:
        return "" if error.errno in _NO_NAMELESS else error.strerror or str(error)
    try:
        written = os.write(file, bytes(ROOM))
    except OSError as error:
        return error.strerror or str(error)
    finally:
        os.close(file)
    return "" if written == ROOM else os.strerror(errno.ENOSPC)


class StateDisk:
    """Looks at the disk of a state directory in a thread.

    Args:
        paths: the threads.
        directory: the state directory.
        note: called in the loop after each look with the fault; "": there is none.
    """

    def __init__(self, paths: PathCalls, directory: Path, note: Callable[[str], None]) -> None:
        self._paths, self._directory, self._note = paths, directory, note
        self._due = 0.0
        self._looks = False

    def look(self, now: float) -> None:
        """Begin a look if one is due, and none is under way."""
        if now < self._due or self._looks:
            return
        self._due, self._looks = now + PERIOD, True
        work = partial(fault_of, self._directory)
        self._paths.run(work, self._seen, lambda error: self._seen(str(error)))

    def _seen(self, fault: str) -> None:
        self._looks = False
        self._note(f"nothing can be written to the state directory: {fault}" if fault else "")
