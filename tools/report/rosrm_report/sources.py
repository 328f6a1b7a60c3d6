"""Sources of reports: a directory, a master's journal, or the record of its run."""

from __future__ import annotations

import json
import shutil
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from rosrm.errors import ConfigError, JournalError
from rosrm.journal.recovery import recover
from rosrm.journal.sqlite import SqliteJournal
from rosrm.model.codec import from_plain
from rosrm.model.records import StoredRecord
from rosrm.model.rows import EventRow
from rosrm.model.values import InstanceId
from rosrm.recording.frames import is_record
from rosrm.supervisor.client import log_path
from rosrm.timeline.values import Failure
from rosrm.wording import counted, reason_of, sanitized
from rosrm_report.model import Material, Readings, Report

if TYPE_CHECKING:
    from rosrm_report.recorded import RecordedRun

#: Files of a demo.
EVENTS_FILE: Final = "events.jsonl"
SAMPLES_FILE: Final = "samples.json"
_JOURNAL: Final = "journal.sqlite"
_SQLITE: Final = b"SQLite format 3\0"
#: Folders below a directory in which a source is found: its own, `master`, `cluster/master`.
_DEPTHS: Final = ("", "*/", "*/*/")
#: Newest events of a journal that are read; a master keeps 100,000 by default.
_MOST_EVENTS: Final = 200_000
#: Log lines of a failure, bytes of a log that are read for them, and failures with log lines.
_LINES: Final = 20
_LOG_BYTES: Final = 16_384
_WITH_LOGS: Final = 200
#: Most characters of a shown line.
_LINE: Final = 400


def read_source(path: Path) -> Material:
    """Read a directory, a journal or a record.

    Raises:
        ConfigError: there is no such source, or a directory has several of them.
        JournalError, RecordError: nothing in the file is readable.
    """
    if path.is_dir():
        return _of_directory(path)
    try:
        with path.open("rb") as file:
            beginning = file.read(64)
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {reason_of(error)}") from None
    if is_record(beginning):
        return _of_record(path)
    if beginning.startswith(_SQLITE) or path.suffix == ".sqlite":
        return _of_journal(path)
    raise ConfigError(
        f"{path}: is neither a master's journal (journal.sqlite) nor the record of its run "
        f"(.rosrec); a directory with one of them is allowed, too"
    )


def _of_directory(directory: Path) -> Material:
    if (directory / EVENTS_FILE).is_file():
        return _of_demo(directory)
    for pattern, read in (("*.rosrec", _of_record), (_JOURNAL, _of_journal)):
        found = [one for depth in _DEPTHS for one in sorted(directory.glob(depth + pattern))]
        if len(found) > 1:
            names = ", ".join(str(one) for one in found[:5])
            raise ConfigError(f"{directory}: has several runs; name one of them: {names}")
        if found:
            return read(found[0])
    raise ConfigError(
        f"{directory}: no run is in it: neither {EVENTS_FILE} of a demo, nor a record (.rosrec), "
        f"nor a journal ({_JOURNAL}) there or up to two folders below"
    )


# --- a demo -----------------------------------------------------------------------------------


def _of_demo(directory: Path) -> Material:
    events, damaged = [], 0
    for line in _text(directory / EVENTS_FILE).splitlines():
        try:
            events.append(from_plain(EventRow, json.loads(line)))
        except (ValueError, TypeError, KeyError, AttributeError):
            damaged += 1
    notes = [f"{counted(damaged, 'line')} of {EVENTS_FILE} cannot be read."] if damaged else []
    readings = None
    if events and (directory / SAMPLES_FILE).is_file():
        try:
            plain = json.loads(_text(directory / SAMPLES_FILE))
            readings = _readings_of_samples(plain, events[0].elapsed)
        except (ValueError, TypeError, KeyError, AttributeError):
            notes.append(f"{SAMPLES_FILE} is damaged.")
    return Material(directory.absolute().name, events, readings, tuple(notes))


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8", errors="replace")
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {reason_of(error)}") from None


def _readings_of_samples(plain: Mapping[str, Any], began: float) -> Readings:
    samples, hosts = plain["samples"], plain["hosts"]
    resources = sorted({name for sample in samples for name in sample["usage"]})
    usage = {
        name: {
            host: tuple(_known(s["usage"].get(name, {}).get(host)) for s in samples)
            for host in hosts
        }
        for name in resources
    }
    limits = {name: dict.fromkeys(hosts, float(of)) for name, of in plain["limits"].items()}
    return Readings(tuple(float(s["elapsed"]) - began for s in samples), usage, limits)


def _known(value: Any) -> float | None:
    return float(value) if isinstance(value, float | int) and isfinite(value) else None


# --- a journal --------------------------------------------------------------------------------


def _of_journal(path: Path) -> Material:
    """Read a copy, because SQLite also writes when it reads."""
    notes: tuple[str, ...] = ()
    with tempfile.TemporaryDirectory(prefix="rosrm-report-") as place:
        copy = Path(place) / _JOURNAL
        try:
            _copy(path, copy)
            try:
                stored = _records(copy)
            except JournalError as fault:
                if "damaged" not in str(fault):
                    raise
                recover(copy)
                stored = _records(copy)[:-1]  # the recovery adds an event of its own
                notes = ("The journal is damaged: the report has its readable part.",)
        except OSError as error:
            raise ConfigError(f"{path}: cannot be read: {reason_of(error)}") from None
        except JournalError as fault:
            raise JournalError(str(fault).replace(str(copy), str(path))) from None
    if len(stored) == _MOST_EVENTS:
        notes += (f"The report has the newest {_MOST_EVENTS} events.",)
    return Material(str(path), [event_of(one) for one in stored], None, notes)


def _copy(path: Path, copy: Path) -> None:
    """Copy a journal that a master may be writing to, and its write-ahead log, of one moment."""
    log = Path(f"{path}-wal")
    for _ in range(5):
        before = _head(log)
        shutil.copyfile(path, copy)
        if before is not None:
            shutil.copyfile(log, f"{copy}-wal")
        if _head(log) == before:  # SQLite gives a log that it begins again another salt
            return


def _head(log: Path) -> bytes | None:
    try:
        with log.open("rb") as file:
            return file.read(32)
    except FileNotFoundError:
        return None


def _records(path: Path) -> Sequence[StoredRecord]:
    journal = SqliteJournal(path)
    try:
        return journal.records(newest=_MOST_EVENTS)
    finally:
        journal.close()


def event_of(stored: StoredRecord) -> EventRow:
    """Return a stored record as an event."""
    one = stored.record
    return EventRow(
        stored.sequence, stored.wall_time, stored.elapsed, one.kind, one.process, one.host,
        one.message, one.facts,
    )  # fmt: skip


# --- a record ---------------------------------------------------------------------------------


def _of_record(path: Path) -> Material:
    from rosrm_report.recorded import read_run  # noqa: PLC0415 - a replay needs the plugins

    run: RecordedRun = read_run(path)
    cut = ("The record is cut short: the report has its complete part.",) if run.cut else ()
    return Material(str(path), run.events, run.readings, cut)


# --- logs -------------------------------------------------------------------------------------


def with_logs(report: Report, directory: Path) -> Report:
    """Return a report with the last log lines of its failures, of the hosts below a directory."""
    depths = (*_DEPTHS, "*/*/*/")
    states = [logs.parent for depth in depths for logs in directory.glob(f"{depth}supervisor/logs")]
    failures = [
        replace(one, lines=_last_lines(states, one)) if at < _WITH_LOGS else one
        for at, one in enumerate(report.failures)
    ]
    return replace(report, failures=tuple(failures))


def _last_lines(states: Sequence[Path], failure: Failure) -> tuple[str, ...]:
    if not failure.number:
        return ()
    for state in states:
        lines = list(_tail(log_path(state, InstanceId(failure.process, failure.number))))
        if lines:
            return tuple(lines)
    return ()


def _tail(path: Path) -> Iterator[str]:
    try:
        with path.open("rb") as file:
            size = file.seek(0, 2)
            file.seek(max(0, size - _LOG_BYTES))
            text = file.read().decode(errors="replace")
    except OSError:
        return
    for line in [one for one in text.splitlines() if one.strip()][-_LINES:]:
        yield sanitized(line, _LINE)
