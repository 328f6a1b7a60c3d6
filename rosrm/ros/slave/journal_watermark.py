"""Journal watermark: the newest record of its master's journal that a slave knows of.

A master that later reports less has a journal gap. The file `journal_seen` of the slave's state
directory holds one line, overwritten in place, so it needs no room on a full disk. It survives the
slave, but not a crash of its machine; nor do the processes that a gap would concern.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Final, NamedTuple

from rosrm.model.values import LARGEST_NUMBER
from rosrm.runtime.path_calls import NewestWrite, RunPath, at, run_at_once
from rosrm.runtime.private_files import open_private

#: Bytes read of the file, at most.
_LONGEST: Final = 1000


class Watermark(NamedTuple):
    """Watermark of the journal of one run of a master.

    Attributes:
        sequence: of its newest record.
        incarnation: of that run.
        master: its name.
    """

    sequence: int
    incarnation: int
    master: str


_NOTHING: Final = Watermark(0, 0, "")


class JournalWatermark:
    """Stores the newest record that the master has reported.

    Args:
        path: of the file; None: only in memory.
        run: as `PathCalls.run`.
    """

    def __init__(self, path: Path | None = None, run: RunPath = run_at_once) -> None:
        self._path = path
        self._file = -1
        self._writes = NewestWrite(run, self._keep)
        self._newest = _read(path) if path is not None else _NOTHING

    def note(self, newest: Watermark) -> None:
        """Store the journal's watermark from the master that this slave is registered with."""
        known = self._newest
        if newest.sequence >= LARGEST_NUMBER:
            return  # a forged beat
        if newest.incarnation == known.incarnation and newest.sequence <= known.sequence:
            return
        self._newest = newest  # after a failed write, the next watermark is written again
        self._writes.put(newest)

    def _keep(self, newest: Watermark) -> None:
        if self._path is None:
            return
        at(self._path)
        if self._file < 0:
            self._file = open_private(str(self._path), os.O_WRONLY | os.O_CREAT)
        line = f"{newest.sequence:020d} {newest.incarnation:020d} {newest.master}\n".encode()
        os.pwrite(self._file, line, 0)
        os.ftruncate(self._file, len(line))

    def of_former_run(self, master: str, incarnation: int) -> int:
        """Return the newest record reported by another run of this master; 0: none."""
        newest = self._newest
        former = newest.master == master and newest.incarnation != incarnation
        return newest.sequence if former else 0


def _read(path: Path) -> Watermark:
    try:
        line, end, _ = path.read_bytes()[:_LONGEST].decode().partition("\n")
        sequence, incarnation, master = line.split(" ", 2)
        return Watermark(int(sequence), int(incarnation), master) if end else _NOTHING
    except (OSError, ValueError):
        return _NOTHING
