"""Journal in SQLite: intents and the event record.

One group of records and intents is one transaction. In WAL mode with `synchronous=NORMAL` a
committed group survives a kill of the process at any instant. With `FULL`, each commit flushes the
disk, so the group also survives a power failure.

A checkpoint of the write-ahead log waits for the disk, too. So it is no part of a write but of
`tidy`, which follows the answer to the write. Readers have a connection of their own, and wait for
no write.
"""

from __future__ import annotations

import contextlib
import json
import os
import sqlite3
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple

from rosrm import clocks
from rosrm.journal.errors import fault_of, no_journal, other_version, removed
from rosrm.journal.retention import Retention, Row
from rosrm.model.event_kinds import EventKind
from rosrm.model.lazy import mapping_to_json
from rosrm.model.records import Intent, Record, StoredRecord
from rosrm.runtime import durable
from rosrm.runtime.private_files import make_private_directory, make_private_file

#: Version of the tables; a file with another version is refused.
SCHEMA: Final = 1

_TABLES: Final = """
CREATE TABLE record (
    sequence INTEGER PRIMARY KEY, wall REAL NOT NULL, elapsed REAL NOT NULL, kind TEXT NOT NULL,
    process TEXT NOT NULL, host TEXT NOT NULL, message TEXT NOT NULL, facts TEXT NOT NULL
);
CREATE INDEX record_process ON record (process) WHERE process != '';
CREATE TABLE intent (
    tbl TEXT NOT NULL, key TEXT NOT NULL, value TEXT NOT NULL, PRIMARY KEY (tbl, key)
) WITHOUT ROWID;
"""

#: Milliseconds for which a write waits while another program has locked the file.
_PATIENCE_MS: Final = 200
#: Bytes of the write-ahead log beyond which a checkpoint begins it again. The first write after a
#: checkpoint cuts the file to this size, so a longer file has new content.
_LONGEST_LOG: Final = 4 << 20


class Group(NamedTuple):
    """Records and intents that are written together, rendered as text.

    Attributes:
        records: in order.
        facts: text of the facts of each record.
        wall: unix time, seconds.
        now: seconds since the start of the master.
        kept: table, key and text of each intent.
        deleted: table and key of each intent that no longer holds.
    """

    records: Sequence[Record]
    facts: Sequence[str]
    wall: float
    now: float
    kept: Sequence[tuple[str, str, str]]
    deleted: Sequence[tuple[str, str]]


class SqliteJournal:
    """Intents and events in one SQLite file.

    Args:
        path: path of the file; a missing file or folder is created.
        sync: "normal" or "full".
        keep_events: number of the newest records that are not deleted.
        keep_bytes: most bytes of the records; the file is larger by its intents and indexes.
        wall: returns the unix time in seconds.

    Raises:
        JournalError: the file is damaged, of another version, in use by another master, or the
            disk is full; the message has the remedy.
    """

    def __init__(
        self,
        path: Path,
        *,
        sync: str = "normal",
        keep_events: int = 100_000,
        keep_bytes: int = 200_000_000,
        wall: Callable[[], float] = clocks.wall_time,
    ) -> None:
        self._path = path
        self._log = f"{path}-wal"
        self._wall = wall
        try:
            make_private_directory(path.parent)
            self._make_private()
        except OSError as error:
            raise fault_of(path, error) from error
        self._database = self._guarded(lambda: self._open(sync))
        self._reader: sqlite3.Connection = self._guarded(lambda: self._connect(_PATIENCE_MS))
        newest = self._guarded(
            lambda: self._reader.execute("SELECT max(sequence) FROM record").fetchone()
        )
        self._sequence = int(newest[0] or 0)
        self._retention: Retention = self._guarded(
            lambda: Retention(self._database, keep_events, keep_bytes)
        )
        self._is_long = False
        self._files: Mapping[str, tuple[int, int]] = self._guarded(self._identities)

    def _identities(self) -> Mapping[str, tuple[int, int]]:
        """Return device and inode of each file that the journal has; {}: none is found."""
        found = {}
        for path in (str(self._path), self._log):
            with contextlib.suppress(FileNotFoundError):
                status = os.stat(path)  # noqa: PTH116 - for each group
                found[path] = (status.st_dev, status.st_ino)
        return found

    def _check_files(self) -> None:
        """Raise `JournalBlocked` for a removed file; SQLite would write to it without an error."""
        present = self._identities()
        for path, identity in self._files.items():
            if present.get(path) != identity:
                raise removed(Path(path))

    def _open(self, sync: str) -> sqlite3.Connection:
        if self._path.is_file() and not self._path.stat().st_size:
            raise sqlite3.DatabaseError("it is empty: not even tables are in it")
        if not self._path.exists():
            self._create()
        database = self._connect(2000)
        try:
            self._prepare(database, sync)
        except BaseException:  # also an interrupt must leave no open file
            database.close()
            raise
        return database

    def _connect(self, patience_ms: int) -> sqlite3.Connection:
        """Return a connection, which one thread at a time uses."""
        return sqlite3.connect(
            self._path, isolation_level=None, timeout=patience_ms / 1000.0, check_same_thread=False
        )

    def _prepare(self, database: sqlite3.Connection, sync: str) -> None:
        database.execute("PRAGMA journal_mode=WAL")
        self._make_private()  # SQLite creates its files by the umask
        database.execute(f"PRAGMA journal_size_limit={_LONGEST_LOG}")
        database.execute("PRAGMA wal_autocheckpoint=0")
        database.execute(f"PRAGMA synchronous={'FULL' if sync == 'full' else 'NORMAL'}")
        (version,) = database.execute("PRAGMA user_version").fetchone()
        if version not in (0, SCHEMA):
            raise other_version(self._path, version, SCHEMA)
        # 0.14 s for 100,000 events; quick_check takes 0.09 s, but does not find damaged indexes.
        (verdict,) = database.execute("PRAGMA integrity_check(1)").fetchone()
        if verdict != "ok":
            raise sqlite3.DatabaseError(verdict)
        if version == 0:
            raise no_journal(self._path)
        database.execute(f"PRAGMA busy_timeout={_PATIENCE_MS}")

    def _make_private(self) -> None:
        """Keep the intents, which hold environments, from other users."""
        for suffix in ("", "-wal", "-shm"):
            make_private_file(f"{self._path}{suffix}")

    def _create(self) -> None:
        """Make the file with its tables, then name it: an empty one would count as damaged."""
        new = f"{self._path}.new"
        # Of a start that was cut, or of a journal that was moved away without its log.
        for left in (new, f"{new}-journal", f"{self._path}-wal", f"{self._path}-shm"):
            Path(left).unlink(missing_ok=True)
        with contextlib.closing(sqlite3.connect(new, isolation_level=None)) as database:
            database.executescript(f"BEGIN; {_TABLES}; PRAGMA user_version={SCHEMA}; COMMIT;")
        make_private_file(new)
        durable.rename_durably(new, str(self._path))

    def _guarded(self, act: Callable[[], Any]) -> Any:
        try:
            return act()
        except (sqlite3.Error, OSError) as error:
            raise fault_of(self._path, error) from error

    @property
    def last_sequence(self) -> int:
        """Return the sequence of the newest record; 0: there is none."""
        return self._sequence

    def write(
        self, records: Sequence[Record], intents: Sequence[Intent], now: float
    ) -> Sequence[StoredRecord]:
        """Append records and replace intents in one atomic group, and tidy.

        Raises:
            JournalBlocked: a temporary failure; nothing was changed, and a retry is safe.
            JournalError: the file is damaged.
        """
        stored = self.commit(self.render(records, intents, now))
        if self.is_untidy:
            self.tidy()
        return stored

    def render(self, records: Sequence[Record], intents: Sequence[Intent], now: float) -> Group:
        """Return a group as text; the policy that made a decision renders it here."""
        facts = [mapping_to_json(record.facts) for record in records]
        newest = {(intent.table, intent.key): intent.value for intent in intents}
        kept = [(*at, mapping_to_json(value)) for at, value in newest.items() if value is not None]
        deleted = [at for at, value in newest.items() if value is None]
        return Group(records, facts, self._wall(), now, kept, deleted)

    def commit(self, group: Group) -> Sequence[StoredRecord]:
        """Write a group; raises as `write`. As long as the journal `is_untidy`, call `tidy` next.

        So no group waits for the disk longer than its own promise needs.
        """
        durable.check_thread()
        stored = [
            StoredRecord(number, group.wall, group.now, record)
            for number, record in enumerate(group.records, self._sequence + 1)
        ]
        rows = list(map(_row, stored, group.facts))
        self._guarded(lambda: self._write(rows, group))
        self._sequence += len(stored)
        self._retention.add(rows)
        self._is_long = self._log_size() > _LONGEST_LOG
        return stored

    def _log_size(self) -> int:
        try:
            return os.stat(self._log).st_size  # noqa: PTH116 - for each group
        except OSError:  # removed: the next write fails
            return 0

    @property
    def is_untidy(self) -> bool:
        """Return True if old events or the write-ahead log exceed their bounds."""
        return self._is_long or self._retention.is_exceeded

    def tidy(self) -> None:
        """Delete old events, and begin the write-ahead log again; this may wait for the disk.

        A failure, such as a full disk, changes nothing: `tidy` is called again after later groups.
        """
        durable.check_thread()
        self._retention.delete()
        if self._is_long:
            with contextlib.suppress(sqlite3.Error):
                self._database.execute("PRAGMA wal_checkpoint(PASSIVE)").fetchall()

    def _write(self, rows: Sequence[Row], group: Group) -> None:
        self._check_files()
        database = self._database
        database.execute("BEGIN IMMEDIATE")
        try:
            database.executemany("INSERT INTO record VALUES (?, ?, ?, ?, ?, ?, ?, ?)", rows)
            database.executemany("INSERT OR REPLACE INTO intent VALUES (?, ?, ?)", group.kept)
            database.executemany("DELETE FROM intent WHERE tbl = ? AND key = ?", group.deleted)
            database.execute("COMMIT")
        except BaseException:  # also an interrupt must leave no open transaction
            if database.in_transaction:
                database.execute("ROLLBACK")
            raise

    def make_durable(self) -> None:
        """Force all that was written to the disk: it survives the loss of power.

        The log itself is forced, because beside a reader SQLite's checkpoint may force nothing.

        Raises:
            JournalBlocked: a temporary failure; a retry is safe.
            JournalError: the file is damaged.
        """

        def force() -> None:
            durable.sync(self._log)
            durable.sync_directory(str(self._path.parent))

        self._guarded(force)

    def tables(self) -> list[str]:
        """Return the tables that have intents; raises `JournalError`."""
        rows = self._guarded(
            lambda: self._reader.execute("SELECT DISTINCT tbl FROM intent ORDER BY tbl").fetchall()
        )
        return [table for (table,) in rows]

    def intents(self, table: str) -> Mapping[str, Mapping[str, Any]]:
        """Return all intents of a table by key."""
        rows = self._guarded(
            lambda: self._reader.execute(
                "SELECT key, value FROM intent WHERE tbl = ?", (table,)
            ).fetchall()
        )
        return {key: self._value(value) for key, value in rows}

    def records(
        self, *, after: int = 0, process: str = "", host: str = "", newest: int = 1000
    ) -> Sequence[StoredRecord]:
        """Return the newest matching records after a sequence, oldest first."""
        where = ["sequence > ?"]
        matched: list[Any] = [after]
        if process:
            where.append("process = ?")
            matched.append(process)
        if host:  # also a migration from it, matched as text, because damaged facts are no JSON
            where.append("(host = ? OR instr(facts, ?))")
            matched += [host, f'"from": {json.dumps(host)}']
        rows = self._guarded(
            lambda: self._reader.execute(
                f"SELECT * FROM record WHERE {' AND '.join(where)} "  # noqa: S608 - fixed words
                "ORDER BY sequence DESC LIMIT ?",
                (*matched, newest),
            ).fetchall()
        )
        return [
            StoredRecord(n, wall, at, Record(EventKind.read(kind), name, on, text, _facts(facts)))
            for n, wall, at, kind, name, on, text, facts in reversed(rows)
        ]

    def _value(self, text: str) -> Any:
        try:
            return json.loads(text)
        except ValueError as error:
            raise fault_of(self._path, sqlite3.DatabaseError(str(error))) from error

    def close(self) -> None:
        """Flush and close the files."""
        # Only the last connection moves the log into the file as it closes.
        self._guarded(self._reader.close)
        self._guarded(self._database.close)


def _row(stored: StoredRecord, facts: str) -> Row:
    record = stored.record
    return (
        stored.sequence, stored.wall_time, stored.elapsed, str(record.kind), record.process,
        record.host, record.message, facts,
    )  # fmt: skip


def _facts(text: str) -> Mapping[str, Any]:
    """Return a record's facts; damaged facts as text, so that other records stay readable."""
    try:
        facts = json.loads(text)
    except ValueError:
        facts = None
    return facts if isinstance(facts, dict) else {"unreadable": text}
