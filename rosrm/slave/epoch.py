"""Note of the master's newest epoch, for the migratable nodes of this host.

A node judges by it which messages about handoffs are its master's. The file `epoch` of the state
directory is overwritten in place, so it needs no room on a full disk.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Final

from rosrm.runtime.path_calls import NewestWrite, RunPath, at

EPOCH_NOTE: Final = "epoch"


class EpochNote:
    """Writes the epoch of the master with which this slave is registered.

    Args:
        path: of the file.
        run: as `PathCalls.run`.
    """

    def __init__(self, path: Path, run: RunPath) -> None:
        self._path = path
        self._written = 0
        self._writes = NewestWrite(run, self._write)

    def note(self, epoch: int) -> None:
        """Write the epoch, unless it is written; a failure is retried with the next call."""
        if epoch != self._written:
            self._writes.put(epoch)

    def _write(self, epoch: int) -> None:
        at(self._path)
        flags = os.O_WRONLY | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW
        file = os.open(self._path, flags, 0o600)
        try:
            os.pwrite(file, f"{epoch:020d}\n".encode(), 0)
            self._written = epoch
        finally:
            os.close(file)
