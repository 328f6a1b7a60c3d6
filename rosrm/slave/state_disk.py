"""Watch of the disks of state and logs: full, read-only, failing, or without an answer."""

from __future__ import annotations

import errno
import os
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Final

from rosrm.runtime.path_calls import PathCall, RunPath, at
from rosrm.wording import reason_of

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
        os.statvfs(directory)  # asks a server, unlike a file without a name, which few of them have
        file = os.open(directory, os.O_TMPFILE | os.O_WRONLY | os.O_CLOEXEC, 0o600)
    except OSError as error:
        return "" if error.errno in _NO_NAMELESS else reason_of(error)
    try:
        written = os.write(file, bytes(ROOM))
    except OSError as error:
        return reason_of(error)
    finally:
        os.close(file)
    return "" if written == ROOM else os.strerror(errno.ENOSPC)


class DiskWatch:
    """Looks at the disk of a directory in a thread.

    Args:
        run: as `PathCalls.run`.
        directory: that is watched.
        part: name of the directory.
        note: called in the loop after each look with the name and the fault; "": there is none.
    """

    def __init__(
        self, run: RunPath, directory: Path, part: str, note: Callable[[str, str], None]
    ) -> None:
        self._run, self._directory, self._part, self._note = run, directory, part, note
        self._due = 0.0
        self._look: PathCall | None = None

    def look(self, now: float) -> None:
        """Begin a look if one is due, and none is under way."""
        if now < self._due or not (self._look is None or self._look.has_ended):
            return
        self._due = now + PERIOD
        work = partial(fault_of, self._directory)
        self._look = self._run(work, self._seen, lambda error: self._seen(str(error)))

    def _seen(self, fault: str) -> None:
        text = f"nothing can be written to the {self._part}: {fault}" if fault else ""
        self._note(self._part, text)
