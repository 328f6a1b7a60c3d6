"""Notices that have not been delivered, the position in the events, and the active alerts, on disk.

One transaction stores the notices of an observation with the position after it. Therefore a kill at
any time loses no notice, and repeats none in the file.
"""

from __future__ import annotations

import json
import os
import sqlite3
import threading
from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from rosrm import EventRow
from rosrm.errors import RosrmError
from rosrm.model.notices import Notice
from rosrm.runtime.private_files import make_safe_directory, open_private
from rosrm.wording import reason_of
from rosrm_alerts.watch import Key, Subject

#: Most notices that wait for one sink; beyond that the oldest are dropped.
MOST: Final = 10_000

#: Fields of an event that are stored.
_KEPT: Final = ("sequence", "wall_time", "elapsed", "kind", "process", "host", "message")

_TABLES: Final = """
CREATE TABLE IF NOT EXISTS notices (
  number INTEGER PRIMARY KEY AUTOINCREMENT, sink TEXT NOT NULL, notice TEXT NOT NULL);
CREATE INDEX IF NOT EXISTS by_sink ON notices (sink, number);
CREATE TABLE IF NOT EXISTS active (
  alert TEXT NOT NULL, host TEXT NOT NULL, process TEXT NOT NULL, began REAL NOT NULL);
CREATE TABLE IF NOT EXISTS position (sequence INTEGER NOT NULL);
CREATE TABLE IF NOT EXISTS last_event (sequence INTEGER NOT NULL, event TEXT NOT NULL);
"""


class OutboxError(RosrmError):
    """The file with undelivered notices cannot be read or written."""


@dataclass(frozen=True, slots=True)
class Waiting:
    """A notice that has not been delivered to its sink."""

    number: int
    notice: Notice


class Outbox:
    """The file of one `rosrm alerts run`; its methods may be called from several threads."""

    def __init__(self, path: Path, most: int = MOST) -> None:
        self._path, self._most = path, most
        self._lock = threading.Lock()
        try:
            make_safe_directory(path.parent)
            # SQLite gives its journal the mode of the file, which notices make private.
            os.close(open_private(str(path), os.O_RDWR | os.O_CREAT))
            self._file = sqlite3.connect(path, check_same_thread=False, timeout=1.0)
            self._file.execute("PRAGMA locking_mode = EXCLUSIVE")
            self._file.executescript(_TABLES)
            with self._file:  # takes the lock now, and keeps it
                self._file.execute("DELETE FROM position WHERE 0")
        except (OSError, sqlite3.Error) as fault:
            hint = "; is another `rosrm alerts run` using it?" if "locked" in str(fault) else ""
            why = reason_of(fault)
            raise OutboxError(f"{path}: the outbox cannot be opened: {why}{hint}") from fault

    def position(self) -> int | None:
        """Return the sequence of the last event that was seen; None: there was none."""
        with self._lock:
            row = self._file.execute("SELECT sequence FROM position").fetchone()
        return None if row is None else int(row[0])

    def last_event(self) -> EventRow | None:
        """Return the event at `position`, without its facts; None: not known.

        After a journal gap the master gives its sequence to another event.
        """
        text = "SELECT event FROM last_event JOIN position USING (sequence)"
        with self._lock:
            row = self._file.execute(text).fetchone()
        return None if row is None else EventRow(**json.loads(row[0]))

    def active(self) -> dict[Key, float]:
        """Return the alerts that were active at the last commit."""
        with self._lock:
            rows = self._file.execute("SELECT alert, host, process, began FROM active").fetchall()
        return {(alert, Subject(host, process)): began for alert, host, process, began in rows}

    def commit(
        self, notices: Sequence[tuple[str, Notice]], position: int | None,
        active: Mapping[Key, float], last_event: EventRow | None = None,
    ) -> int:  # fmt: skip
        """Store notices, each with the name of its sink; return the number of dropped ones."""
        rows = [(sink, json.dumps(notice.form())) for sink, notice in notices]
        dropped = 0
        try:
            with self._lock, self._file:
                self._file.executemany("INSERT INTO notices (sink, notice) VALUES (?, ?)", rows)
                self._file.execute("DELETE FROM position")
                if position is not None:
                    self._file.execute("INSERT INTO position VALUES (?)", (position,))
                self._file.execute("DELETE FROM last_event")
                if last_event is not None:
                    fields = {name: getattr(last_event, name) for name in _KEPT}
                    row = (position, json.dumps(fields))
                    self._file.execute("INSERT INTO last_event VALUES (?, ?)", row)
                self._file.execute("DELETE FROM active")
                self._file.executemany(
                    "INSERT INTO active VALUES (?, ?, ?, ?)",
                    [(name, of.host, of.process, at) for (name, of), at in active.items()],
                )
                for sink in {sink for sink, _ in notices}:
                    dropped += self._drop_oldest(sink)
        except sqlite3.Error as fault:
            raise OutboxError(f"{self._path}: notices cannot be stored: {fault}") from fault
        return dropped

    def _drop_oldest(self, sink: str) -> int:
        newest = "SELECT number FROM notices WHERE sink = ? ORDER BY number DESC LIMIT ?"
        return self._file.execute(
            f"DELETE FROM notices WHERE sink = ? AND number NOT IN ({newest})",  # noqa: S608 - own text
            (sink, sink, self._most),
        ).rowcount

    def waiting(self, sink: str, most: int) -> list[Waiting]:
        """Return the oldest notices for a sink."""
        text = "SELECT number, notice FROM notices WHERE sink = ? ORDER BY number LIMIT ?"
        with self._lock:
            rows = self._file.execute(text, (sink, most)).fetchall()
        return [Waiting(number, Notice(**json.loads(notice))) for number, notice in rows]

    def delivered(self, waiting: Sequence[Waiting]) -> None:
        """Remove notices. Raises OutboxError."""
        try:
            with self._lock, self._file:
                self._file.executemany(
                    "DELETE FROM notices WHERE number = ?", [(one.number,) for one in waiting]
                )
        except sqlite3.Error as fault:
            raise OutboxError(f"{self._path}: notices cannot be removed: {fault}") from fault

    def close(self) -> None:
        """Close the file."""
        with self._lock, closing(self._file):
            pass
