"""Writes to the journal in a thread: a slow disk delays decisions, but no beat of the master.

A `COMMIT` may wait for the disk: with `journal.sync: full` each one, with `normal` the first one
after a checkpoint. On a busy disk that takes seconds, and hosts that receive no beat fence their
processes.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Final

from rosrm.errors import JournalBlocked
from rosrm.journal.sqlite import SqliteJournal
from rosrm.model.records import Intent, Record, StoredRecord
from rosrm.runtime.file_thread import Call, FileThread

#: Seconds for which the loop waits for a write; less than a beat period.
_PATIENCE: Final = 0.1
#: Seconds for which the end of the master waits for the disk: for the last write, and for the
#: close.
_AT_END: Final = 10.0

_log = logging.getLogger("rosrm.master")


class JournalLate(JournalBlocked):
    """A write takes longer than the loop waits. It continues, so it must not be repeated."""


class JournalWriter:
    """Writes groups to a journal, one at a time, in a thread.

    Args:
        journal: this object closes it.
        path: of the journal, for error texts.
    """

    def __init__(self, journal: SqliteJournal, path: Path) -> None:
        self._journal = journal
        self._path = path
        self._thread = FileThread(str(path.parent), _PATIENCE)
        self._write: Call[Sequence[StoredRecord]] | None = None

    def write(
        self, records: Sequence[Record], intents: Sequence[Intent], elapsed: float
    ) -> Sequence[StoredRecord]:
        """Write a group; the write before it has an outcome.

        Args:
            elapsed: seconds since the start of the master.

        Raises:
            JournalLate: the outcome is not known yet; it will be that of `outcome`.
            JournalBlocked: a temporary failure; nothing was changed, and a retry is safe.
            JournalError: the file is damaged.
        """
        # Only in this thread is a plugin, which renders its decision, called with a time-out.
        group = self._journal.render(records, intents, elapsed)
        self._write = self._thread.begin(partial(self._journal.commit, group))
        return self.outcome()

    def outcome(self) -> Sequence[StoredRecord]:
        """Return or raise the outcome of the last write, as `write`."""
        assert self._write is not None
        if not self._thread.ends(self._write):
            raise self._late(self._thread.waits())
        stored = self._write.result()
        if self._journal.is_untidy:
            self._thread.begin(self._journal.tidy)
        return stored

    def write_durably(
        self,
        records: Sequence[Record],
        intents: Sequence[Intent],
        while_waiting: Callable[[], object],
    ) -> None:
        """Write the first group of a run, which survives a loss of power; raises as `write`.

        Args:
            records: of the group.
            intents: of the group.
            while_waiting: called every 0.1 s until then, however slow the disk is.
        """

        def write() -> None:
            self._journal.write(records, intents, 0.0)
            self._journal.make_durable()

        call = self._thread.begin(write)
        while not call.wait(_PATIENCE):
            while_waiting()
        call.result()

    def write_last(self, record: Record, elapsed: float) -> None:
        """Write the last record, and wait for it up to 10 s; raises as `write`."""
        group = self._journal.render([record], [], elapsed)
        call = self._thread.begin(partial(self._journal.commit, group))
        if not call.wait(_AT_END):
            raise self._late(self._thread.waits())
        call.result()

    def close(self) -> bool:
        """Close the journal; return False, and log a warning, if the disk does not answer in 10 s.

        Raises:
            JournalError: the files cannot be closed.
        """
        call = self._thread.begin(self._journal.close)
        if call.wait(_AT_END):
            call.result()
            return True
        _log.warning("%s; the master ends without it", self._late(self._thread.waits()))
        return False

    def _late(self, seconds: float) -> JournalLate:
        what = f"the disk has not answered for {seconds:.1f} s"
        advice = "wait until it answers, or see what keeps it busy; no acknowledged request is lost"
        return JournalLate(
            f"the journal {self._path} cannot be used ({what}): {advice}",
            f"the journal of the master cannot be used ({what}); {advice}",
        )
