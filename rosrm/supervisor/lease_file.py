"""Times of the last contact with the master and of the slave's last activity, for a take-over.

The file `heard` of the state directory holds one line of fixed length, which is overwritten: the
id of this boot, and the two times by its boot clock. So it needs no room on a full disk, and
no compaction. Where it is missing, the recorded start of each instance counts.
"""

from __future__ import annotations

import os
from math import inf
from typing import Final

from rosrm.core.supervisor.events import ContactReported
from rosrm.runtime.file_thread import FileThread
from rosrm.runtime.private_files import open_private
from rosrm.shortage import raise_shortage
from rosrm.supervisor import own_log, paths, procfs
from rosrm.wording import reason_of

_NONE: Final = ContactReported(-inf, -inf)


class LastContact:
    """Stores the newest times, in a thread."""

    def __init__(self, state: str, disk: FileThread) -> None:
        self._disk = disk
        self._is_queued = False
        self._path = os.path.join(state, paths.HEARD)
        self._boot = procfs.boot_id()
        self._file = -1
        self._newest = ContactReported(0.0)
        self._trouble = ""

    def keep(self, contact: ContactReported) -> None:
        """Write newer times to the file, so that they survive this process."""
        newest = ContactReported(*map(max, contact, self._newest))
        if newest == self._newest:
            return
        self._newest = newest
        if not self._is_queued:
            self._is_queued = True
            self._disk.tell(self._write)

    def _write(self) -> None:
        self._is_queued = False
        newest = self._newest
        try:
            if self._file < 0:
                self._file = open_private(self._path, os.O_WRONLY | os.O_CREAT)
            line = f"{self._boot} {newest.at:020.6f} {newest.alive:020.6f}\n"
            os.pwrite(self._file, line.encode(), 0)
            self._trouble = ""
        except OSError as error:
            trouble = reason_of(error)
            if trouble != self._trouble:
                own_log.write(f"{self._path} cannot be written: {trouble}")
            self._trouble = trouble


def read(state: str) -> ContactReported:
    """Return the times stored since this machine's start; `-inf`: none.

    The times of a fence that was due before that start are negative, so 0.0 would be newer.

    Raises:
        OSError: the system has no room for another descriptor; older times would end a process.
    """
    try:
        with open(os.path.join(state, paths.HEARD), encoding="ascii") as file:
            boot, at, alive = file.read(100).split()
        newest = ContactReported(float(at), float(alive))
    except OSError as error:
        raise_shortage(error)
        return _NONE
    except ValueError:
        return _NONE
    return newest if boot == procfs.boot_id() else _NONE
