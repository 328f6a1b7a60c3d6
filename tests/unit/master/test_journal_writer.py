"""Writes that wait for the disk: their outcome, order and end."""

from __future__ import annotations

import contextlib
import sqlite3
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import pytest

from rosrm.errors import JournalBlocked
from rosrm.journal.sqlite import SqliteJournal
from rosrm.master import journal_writer
from rosrm.master.journal_writer import JournalLate, JournalWriter
from rosrm.model.event_kinds import EventKind
from rosrm.model.lazy import Lazy
from rosrm.model.records import Intent, Record, StoredRecord
from tests.waiting import wait_until


class SlowJournal(SqliteJournal):
    """Journal on a disk that answers as soon as the test opens the gate."""

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self.gate = threading.Event()
        self.gate.set()
        self.tidied = 0
        self._database.set_trace_callback(self._execute)

    def _execute(self, statement: str) -> None:
        if statement == "COMMIT":
            self.gate.wait()  # with the lock of the connection, as a sync

    def tidy(self) -> None:
        self.tidied += 1
        self.gate.clear()
        self.gate.wait()


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "journal.sqlite"


@pytest.fixture
def journal(path: Path) -> Iterator[SlowJournal]:
    journal = SlowJournal(path)
    yield journal
    journal.gate.set()


@pytest.fixture
def writer(journal: SlowJournal, path: Path) -> JournalWriter:
    return JournalWriter(journal, path)


def outcome(writer: JournalWriter) -> list[StoredRecord]:
    """Return or raise the outcome of a late write, once it has one."""

    def has_ended() -> list[object]:
        try:
            return [writer.outcome()]
        except JournalLate:
            return []

    return wait_until(has_ended, "the end of the write")[0]


def seconds_of(call: Callable[[], object]) -> float:
    began = time.monotonic()
    call()
    return time.monotonic() - began


def test_a_slow_write_is_late_and_waited_for_once(writer, journal) -> None:
    """Queries wait for no write, and see nothing that is not durable."""
    writer.write([Record("one")], [], 0.0)
    journal.gate.clear()
    with pytest.raises(JournalLate, match=r"disk has not answered for 0\.\d s"):
        writer.write([Record("two")], [Intent("process", "p", {})], 1.0)

    def look() -> None:
        for _ in range(50):
            with pytest.raises(JournalLate):
                writer.outcome()
            assert [one.record.kind for one in journal.records()] == ["one"]

    assert seconds_of(look) < 2.0
    journal.gate.set()
    (stored,) = outcome(writer)
    assert (stored.sequence, stored.record.kind) == (2, "two")
    assert journal.last_sequence == 2
    assert journal.intents("process") == {"p": {}}
    (stored,) = writer.write([Record("three")], [], 2.0)
    assert stored.sequence == 3


def test_a_late_write_may_fail(writer, journal, path) -> None:
    writer.write([Record("one")], [], 0.0)
    with contextlib.closing(sqlite3.connect(path, isolation_level=None)) as other:
        other.execute("BEGIN IMMEDIATE")
        with pytest.raises(JournalLate):
            writer.write([Record("two")], [], 0.0)
        with pytest.raises(JournalBlocked, match="another program has it open"):
            outcome(writer)
    assert writer.write([Record("two")], [], 0.0)[0].sequence == 2


def test_a_group_is_answered_before_the_journal_is_tidied(writer, journal, monkeypatch) -> None:
    """A checkpoint waits for the disk; only the next group waits for the checkpoint."""
    monkeypatch.setattr(SqliteJournal, "is_untidy", property(lambda _: not journal.tidied))
    assert writer.write([Record("one")], [], 0.0)
    with pytest.raises(JournalLate):
        writer.write([Record("two")], [], 0.0)
    assert journal.tidied == 1
    journal.gate.set()
    assert outcome(writer)[0].sequence == 2


def test_the_end_waits_for_a_hung_disk_only_so_long(
    writer, journal, monkeypatch, caplog
) -> None:  # fmt: skip
    """The caller learns that a write may still succeed."""
    monkeypatch.setattr(journal_writer, "_AT_END", 0.2)
    journal.gate.clear()
    with pytest.raises(JournalLate):
        writer.write_last(Record("stopped"), 0.0)
    assert not writer.close()
    assert "the master ends without it" in caplog.text
    journal.gate.set()


def test_the_last_record_follows_a_late_write(writer, journal, path) -> None:
    journal.gate.clear()
    with pytest.raises(JournalLate):
        writer.write([Record("one")], [], 0.0)
    threading.Timer(0.1, journal.gate.set).start()
    writer.write_last(Record("stopped"), 0.0)
    assert writer.close()
    kinds = [one.record.kind for one in SqliteJournal(path).records()]
    assert kinds == ["one", "stopped"]


def test_beats_are_sent_until_the_first_group_is_durable(writer, journal) -> None:
    journal.gate.clear()
    beats: list[float] = []

    def beat() -> None:
        beats.append(time.monotonic())
        if len(beats) == 3:
            journal.gate.set()

    writer.write_durably([Record("started")], [], while_waiting=beat)
    assert len(beats) >= 3
    assert journal.last_sequence == 1


def test_a_decision_is_rendered_in_the_thread_that_bounds_calls_of_plugins(
    writer: JournalWriter,
) -> None:
    """A policy that renders its decision may hang."""
    threads = []

    class Decided(Lazy):
        def render(self) -> Mapping[str, Any]:
            threads.append(threading.current_thread())
            return {"host": "a"}

    writer.write([Record(EventKind.ASSIGNED, facts={"decision": Decided()})], [], 0.0)
    assert threads == [threading.current_thread()]
