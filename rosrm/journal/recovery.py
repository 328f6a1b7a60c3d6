"""Recovery of a damaged journal: a new journal gets the readable part; the old file is not deleted.

The intents and events on a damaged page are lost, so the new journal has a gap. A process whose
intent is lost is stopped as its slave registers. Two losses could start a process twice and are
repaired here: the hosts of processes, and the numbers of instances.
"""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import sqlite3
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from rosrm import clocks
from rosrm.errors import JournalBlocked, JournalError
from rosrm.journal.errors import fault_of
from rosrm.journal.sqlite import SqliteJournal
from rosrm.model.event_kinds import EventKind
from rosrm.model.records import Intent, Record
from rosrm.runtime.disk_space import room_for
from rosrm.runtime.durable import rename_durably
from rosrm.wording import counted, reason_of

_BESIDE: Final = ("-wal", "-shm")
#: A scan ends at a damaged page. So events are read from the end and in small groups. Intents are
#: read from both ends, then one by one by the names in the events.
_EVENTS: Final = "SELECT * FROM record WHERE sequence BETWEEN ? AND ? AND facts IS NOT NULL"
_NEWEST_EVENTS: Final = "SELECT * FROM record WHERE facts IS NOT NULL ORDER BY sequence DESC"
_FEW: Final = 50
_MOST_EVENTS: Final = 2_000_000
_INTENTS: Final = (
    "SELECT tbl, key, value FROM intent ORDER BY tbl, key",
    "SELECT tbl, key, value FROM intent ORDER BY tbl DESC, key DESC",
)
_INTENT: Final = "SELECT tbl, key, value FROM intent WHERE tbl = ? AND key = ?"
#: Highest number of bytes that are added (sparsely) to a truncated file.
_MOST_EMPTY: Final = 2**30
#: Instance numbers left unused above the largest known one.
_FREE: Final = 1000
#: Facts of events with instance numbers, and the exclusive upper bound of instance numbers.
_NUMBERS: Final = ("number", "source", "destination")
_NO_NUMBER: Final = 2**53


@dataclass(slots=True)
class _Found:
    """The readable rows of a file as stored: intents by table and key, events by sequence."""

    copy: Path
    intents: dict[tuple[str, str], dict[str, Any]] = field(default_factory=dict)
    events: dict[int, tuple[Any, ...]] = field(default_factory=dict)
    whole: bool = True


def recover(path: Path, wall: Callable[[], float] = clocks.wall_time) -> str:
    """Write a new journal from the readable part of a damaged one.

    Args:
        path: path of the journal; no master may have the file open.
        wall: returns the unix time in seconds.

    Returns:
        A summary for the user: number of recovered rows, and the new path of the damaged file.

    Raises:
        JournalError: the journal is not damaged, nothing in it is readable, or space or a
            permission is missing; the journal is unchanged.
    """
    _check_damaged(path)
    try:
        return _recover(path, wall)
    except (OSError, sqlite3.Error) as error:
        raise _not_recovered(path, error) from error
    except JournalBlocked as blocked:  # raised by the new journal
        raise _not_recovered(path, blocked.__cause__ or blocked) from blocked


def _recover(path: Path, wall: Callable[[], float]) -> str:
    _undo_interrupted(path)
    with tempfile.TemporaryDirectory(dir=path.parent, prefix="recovery-") as place:
        found = _salvage(path, Path(place))
        new = Path(place) / "new.sqlite"
        aside = path.with_name(f"{path.name}.damaged-{int(wall())}")
        _write(new, found, aside)
        # A journal must exist at every moment: a master without one stops every process.
        os.link(path, aside)
        try:
            _move_beside(path, aside)
            rename_durably(str(new), str(path))
        except OSError:
            _undo_interrupted(path)
            raise
    return _summary(found, str(aside))


def _undo_interrupted(path: Path) -> None:
    """Return to a damaged journal the files beside it that an unfinished recovery moved away."""
    same = [one for one in path.parent.glob(f"{path.name}.damaged-*") if one.samefile(path)]
    for aside in same:
        _move_beside(aside, path)
        aside.unlink()


def _move_beside(source: Path, target: Path) -> None:
    for suffix in _BESIDE:
        with contextlib.suppress(FileNotFoundError):
            Path(f"{source}{suffix}").replace(f"{target}{suffix}")


def _not_recovered(path: Path, error: BaseException) -> JournalError:
    why = reason_of(error)
    room = room_for(path)
    return JournalError(
        f"the journal {path} was not recovered and is unchanged: {why}. A recovery needs free "
        f"space beside it of twice its size{f' ({room})' if room else ''}, and the right to write "
        f"into its folder"
    )


def _check_damaged(path: Path) -> None:
    if not path.is_file():
        raise JournalError(f"there is no journal to recover: {path} is no file")
    try:
        with contextlib.closing(SqliteJournal(path)) as journal:
            for table in journal.tables():
                journal.intents(table)
    except JournalError as fault:
        if "damaged" not in str(fault):
            raise
    else:
        raise JournalError(f"the journal {path} is not damaged: start without `--recover`")


def _salvage(path: Path, place: Path) -> _Found:
    """Read a copy, because SQLite also writes when it reads (`-shm`, a checkpoint)."""
    copy = place / "damaged.sqlite"
    for suffix in ("", "-wal"):
        with contextlib.suppress(FileNotFoundError):
            shutil.copyfile(f"{path}{suffix}", f"{copy}{suffix}")
    _fill_up(copy)
    found = _Found(copy)
    with contextlib.closing(sqlite3.connect(copy)) as database:
        database.text_factory = lambda raw: raw.decode(errors="replace")
        _read_events(database, found)
        _read_intents(database, found)
    if not found.intents:
        raise JournalError(
            f"the journal {path} has no readable part: restore it from a backup, or move it away "
            f"to start with an empty one"
        )
    return found


def _fill_up(copy: Path) -> None:
    """Add empty pages, because SQLite refuses a file that is shorter than its header states."""
    head = copy.read_bytes()[:32]
    page, count = int.from_bytes(head[16:18], "big"), int.from_bytes(head[28:32], "big")
    size = copy.stat().st_size
    if head.startswith(b"SQLite format 3\0") and size < page * count < _MOST_EMPTY + size:
        os.truncate(copy, page * count)


def _read_events(database: sqlite3.Connection, found: _Found) -> None:
    for row in _rows(database, found, _NEWEST_EVENTS):
        found.events[int(row[0])] = row
    newest = max(found.events, default=_MOST_EVENTS)
    for first in range(max(0, newest - _MOST_EVENTS), newest, _FEW):
        for row in _rows(database, found, _EVENTS, first, first + _FEW - 1):
            found.events[int(row[0])] = row


def _read_intents(database: sqlite3.Connection, found: _Found) -> None:
    processes = sorted({str(event[4]) for event in found.events.values() if event[4]})
    hosts = sorted({str(event[5]) for event in found.events.values() if event[5]})
    known = [("cluster", "epoch"), ("cluster", "instances")]
    known += [("host", name) for name in hosts]
    known += [(table, name) for name in processes for table in ("process", "migration", "removed")]
    rows = [row for query in _INTENTS for row in _rows(database, found, query)]
    rows += [row for at in known for row in _rows(database, found, _INTENT, *at)]
    for table, key, text in rows:
        with contextlib.suppress(ValueError, TypeError):
            found.intents[str(table), str(key)] = dict(json.loads(text))


def _rows(
    database: sqlite3.Connection, found: _Found, query: str, *values: object
) -> Iterator[tuple[Any, ...]]:
    """Return the rows up to the first unreadable one; a shortage is no damage, and raises."""
    try:
        yield from database.execute(query, values)
    except sqlite3.Error as error:
        if isinstance(fault_of(found.copy, error), JournalBlocked):
            raise
        found.whole = False


def _write(path: Path, found: _Found, aside: Path) -> None:
    _add_lost_rows(found)
    SqliteJournal(path).close()
    with contextlib.closing(sqlite3.connect(path)) as database, database:
        database.executemany(
            f"INSERT INTO record VALUES ({', '.join('?' * 8)})",  # noqa: S608 - fixed words
            [found.events[sequence] for sequence in sorted(found.events)],
        )
    intents = [Intent(table, key, value) for (table, key), value in found.intents.items()]
    note = Record(EventKind.JOURNAL_RECOVERED, message=_summary(found, aside.name))
    # The master's own bound on events holds later.
    with contextlib.closing(SqliteJournal(path, keep_events=_MOST_EVENTS)) as journal:
        journal.write([note], intents, 0.0)
    _complete(path, len(intents), len(found.events) + 1)


def _complete(path: Path, intents: int, events: int) -> None:
    """Move all rows from the write-ahead log into the file, as only the file gets the new name.

    The close of a journal ignores that the disk has no room for them; a change of the mode does
    not.
    """
    with contextlib.closing(sqlite3.connect(path)) as database:
        (mode,) = database.execute("PRAGMA journal_mode=DELETE").fetchone()
        (verdict,) = database.execute("PRAGMA integrity_check(1)").fetchone()
        counts = [
            database.execute(f"SELECT count(*) FROM {table}").fetchone()[0]  # noqa: S608
            for table in ("intent", "record")
        ]
    if (mode, verdict, counts) != ("delete", "ok", [intents, events]):
        raise sqlite3.DatabaseError(f"the new journal is incomplete ({mode}, {verdict}, {counts})")


def _add_lost_rows(found: _Found) -> None:
    """Add lost rows on which the remaining intents depend."""
    hosts = {key for table, key in found.intents if table == "host"}
    ids = [int(found.intents["host", name].get("host_id", 0)) for name in hosts]
    largest = _largest_reported(found)
    for (table, _), process in list(found.intents.items()):
        if table != "process":
            continue
        for number, host in process.get("instances", {}).items():
            largest = max(largest, int(number))
            if host not in hosts:
                hosts.add(host)
                ids.append(max(ids, default=0) + 1)
                known = {"host_id": ids[-1], "cordoned": False, "draining": False}
                found.intents["host", host] = known
    found.intents.setdefault(("cluster", "instances"), {"next": largest + _FREE})
    epoch = found.intents.setdefault(("cluster", "epoch"), {"epoch": 0})
    epoch["boot"] = "recovered"  # as after a reboot: the master first waits for all hosts


def _largest_reported(found: _Found) -> int:
    """Return the largest instance number in the events, those of ended instances included.

    A supervisor that has dropped an ended instance refuses to start any number up to its own.
    """
    largest = 0
    for event in found.events.values():
        with contextlib.suppress(ValueError, TypeError):
            facts = dict(json.loads(event[7]))
            reported = [facts[name] for name in _NUMBERS if type(facts.get(name)) is int]
            largest = max([largest, *(number for number in reported if number < _NO_NUMBER)])
    return largest


def _summary(found: _Found, aside: str) -> str:
    processes = sum(table == "process" for table, _ in found.intents)
    hosts = sum(table == "host" for table, _ in found.intents)
    part = "with all of its rows:" if found.whole else "with its readable rows:"
    held = counted(processes, "process", "processes")
    events = counted(len(found.events), "event")
    return (
        f"the journal was recovered from a damaged one, {part} {held}, {counted(hosts, 'host')} "
        f"and {events}; the damaged file is {aside}. Submit again each process that `rosrm ps` "
        f"does not list: a missing process that still runs is stopped"
    )
