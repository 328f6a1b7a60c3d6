"""When the master last heard this host, kept for a supervisor that has to take over.

The file `heard` of the state directory holds one line of fixed length, which is overwritten: the
id of this boot, and the time by its CLOCK_MONOTONIC. So it needs no room on a full disk, and no
compaction. Where it is missing, what the record says of each instance counts: its start.
"""

from __future__ import annotations

import os

from rosrm.supervisor import members, own_log, paths


class LastHeard:
    """Keeps the newest time."""

    def __init__(self, state: str) -> None:
        self._path = os.path.join(state, paths.HEARD)
        self._boot = members.boot_id()
        self._file = -1
        self._newest = 0.0
        self._trouble = ""

    def keep(self, at: float) -> None:
        """Hand it to the kernel, so that it survives this process."""
        if at <= self._newest:
            return
        self._newest = at
        try:
            if self._file < 0:
                flags = os.O_WRONLY | os.O_CREAT | os.O_CLOEXEC
                self._file = os.open(self._path, flags, 0o600)
            os.pwrite(self._file, f"{self._boot} {at:020.6f}\n".encode(), 0)
            self._trouble = ""
        except OSError as error:
            trouble = error.strerror or str(error)
            if trouble != self._trouble:
                own_log.say(f"{self._path} cannot be written: {trouble}")
            self._trouble = trouble


def read(state: str) -> float:
    """The time that was kept since this machine's start; 0.0: none."""
    try:
        with open(os.path.join(state, paths.HEARD), encoding="ascii") as file:
            boot, at = file.read(100).split()
        return float(at) if boot == members.boot_id() else 0.0
    except (OSError, ValueError):
        return 0.0
