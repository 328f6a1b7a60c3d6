"""Recovery of a damaged journal: readable data is kept, and so is the damaged file."""

from __future__ import annotations

import contextlib
import os
import sqlite3
from unittest import mock

import pytest

from rosrm.errors import JournalError
from rosrm.journal import recovery
from rosrm.journal.recovery import recover
from rosrm.journal.sqlite import SqliteJournal
from rosrm.model.records import Intent, Record

PAGE = 4096
COUNT = 300


@pytest.fixture
def path(tmp_path):
    path = tmp_path / "state" / "journal.sqlite"
    journal = SqliteJournal(path)
    journal.write([], [Intent("host", f"h{n}", {"host_id": n + 1}) for n in range(3)], 0.0)
    journal.write([], [Intent("cluster", "instances", {"next": 2001})], 0.0)
    journal.write([], [Intent("cluster", "epoch", {"epoch": 4, "boot": "this"})], 0.0)
    for number in range(COUNT):
        name, on = f"p{number:03}", {str(number): f"h{number % 3}"}
        process = {"order": number, "instances": on, "spec": "x" * 200}
        journal.write([Record("assigned", name)], [Intent("process", name, process)], 0.0)
    journal.close()
    return path


@pytest.fixture
def recovered(path):
    """Return a function that recovers the journal and opens it until the end of the test."""
    with contextlib.ExitStack() as stack:

        def recover_and_open() -> SqliteJournal:
            recover(path)
            return stack.enter_context(contextlib.closing(SqliteJournal(path)))

        yield recover_and_open


def spoil(path, table: str, which: int) -> None:
    """Overwrite one of the pages that are known to hold rows of a table."""
    mark = {"intent": b'{"order": ', "record": b"assigned"}[table]
    raw = bytearray(path.read_bytes())
    pages = [slice(at, at + PAGE) for at in range(PAGE, len(raw), PAGE)]
    holding = [page for page in pages if mark in raw[page] and raw[page.start] in (10, 13)]
    raw[holding[which]] = os.urandom(PAGE)
    path.write_bytes(raw)


@pytest.mark.parametrize("which", [0, 1, -1])
def test_readable_records_are_recovered(path, which) -> None:
    """With one damaged page of intents the others are restored, in both directions from it."""
    spoil(path, "intent", which)
    damaged = path.read_bytes()
    with pytest.raises(JournalError, match="--recover"):
        SqliteJournal(path)

    said = recover(path, wall=lambda: 1700.0)

    aside = path.with_name("journal.sqlite.damaged-1700")
    assert aside.read_bytes() == damaged
    assert str(aside) in said
    journal = SqliteJournal(path)
    processes = journal.intents("process")
    assert COUNT - 40 < len(processes) < COUNT
    assert all(value["order"] == int(name[1:]) for name, value in processes.items())
    assert f"{len(processes)} processes" in said
    assert journal.records(newest=1)[0].record.kind == "journal_recovered"
    assert journal.last_sequence == COUNT + 1
    journal.close()


def test_a_file_cut_short_is_recovered_up_to_the_cut(path, recovered) -> None:
    """SQLite alone would read nothing of it; the amount depends on the remaining pages."""
    raw = path.read_bytes()
    path.write_bytes(raw[: len(raw) * 3 // 4])
    assert 0 < len(recovered().intents("process")) < COUNT


def test_damaged_events_cost_no_intent(path, recovered) -> None:
    """Events are information for users only."""
    spoil(path, "record", 1)
    journal = recovered()
    assert len(journal.intents("process")) == COUNT
    assert journal.intents("cluster")["instances"] == {"next": 2001}
    assert COUNT / 2 < len(journal.records(newest=10**6)) <= COUNT


def test_what_is_left_is_put_right(path, recovered) -> None:
    """Hosts of processes are expected, and no number is used twice."""
    with sqlite3.connect(path) as database:
        database.execute("DELETE FROM intent WHERE tbl IN ('host', 'cluster')")
    spoil(path, "record", 0)
    journal = recovered()
    hosts = journal.intents("host")
    assert set(hosts) == {"h0", "h1", "h2"}
    assert len({host["host_id"] for host in hosts.values()}) == 3
    assert journal.intents("cluster")["instances"]["next"] >= COUNT


def test_numbers_go_on_above_all_that_events_know(path, recovered) -> None:
    """Supervisors refuse numbers whose end they have seen, however few instances live now."""
    journal = SqliteJournal(path)
    ended = Record("ended", "p000", facts={"number": 70_000, "pid": 1})
    moved = Record("moved", "p000", facts={"source": 3, "destination": 90_000})
    odd = Record("odd", "p000", facts={"number": "100000", "destination": True})
    journal.write([ended, moved, odd], [Intent("cluster", "instances", None)], 0.0)
    journal.close()
    spoil(path, "record", 0)
    assert 90_000 < recovered().intents("cluster")["instances"]["next"] < 100_000


class Killed(BaseException):
    """Fake SIGKILL: no code of rosrm may handle it."""


@pytest.mark.parametrize("step", range(5))
def test_killed_at_any_step_the_journal_is_the_damaged_one_or_the_new_one(
    path, monkeypatch, step
) -> None:
    """A missing journal would start a new cluster; after the kill the recovery can be repeated."""
    spoil(path, "intent", 1)
    damaged = path.read_bytes()
    steps = iter(range(100))

    def dying(act):
        def call(*args, **options):
            if any(str(path) in str(one) for one in args) and next(steps) == step:
                raise Killed
            return act(*args, **options)

        return call

    with monkeypatch.context() as patch:
        for name in ("link", "rename", "replace", "unlink"):
            patch.setattr(os, name, dying(getattr(os, name)))
        with contextlib.suppress(Killed):
            recover(path, wall=lambda: 1700.0)
    assert path.exists()
    if path.read_bytes() == damaged:
        recover(path, wall=lambda: 1800.0)
    journal = SqliteJournal(path)
    assert journal.records(newest=1)[0].record.kind == "journal_recovered"
    journal.close()
    kept = [one.read_bytes() for one in path.parent.glob("journal.sqlite.damaged-*")]
    assert kept
    assert all(one == damaged for one in kept)


@pytest.mark.parametrize("step", range(6))
@pytest.mark.parametrize("kind", [Killed, OSError])
def test_an_interrupted_recovery_keeps_the_write_ahead_log(path, monkeypatch, step, kind) -> None:
    """A damaged journal may still have one, with the newest rows."""
    log = path.with_name("journal.sqlite-wal")
    with contextlib.closing(SqliteJournal(path)) as journal:
        journal.write([], [Intent("process", "newest", {"instances": {}})], 0.0)
        files = {one: one.read_bytes() for one in (path, log)}  # as a SIGKILL leaves them
    for one, content in files.items():
        one.write_bytes(content)
    monkeypatch.setattr(recovery, "_check_damaged", lambda _: None)
    steps = iter(range(100))

    def dying(act):
        def call(*args, **options):
            if any(str(path) in str(one) for one in args) and next(steps) == step:
                raise kind
            return act(*args, **options)

        return call

    with monkeypatch.context() as patch:
        for name in ("link", "rename", "replace", "unlink"):
            patch.setattr(os, name, dying(getattr(os, name)))
        with contextlib.suppress(Killed, JournalError):
            recover(path, wall=lambda: 1700.0)
    if path.read_bytes() == files[path]:
        assert kind is Killed or log.read_bytes() == files[log]
        recover(path, wall=lambda: 1800.0)
    with contextlib.closing(SqliteJournal(path)) as journal:
        assert "newest" in journal.intents("process")
        assert len(journal.intents("process")) == COUNT + 1


def test_a_shortage_is_no_damage(path, monkeypatch) -> None:
    """Rows that cannot be read for lack of room are not lost: the recovery can be repeated."""
    spoil(path, "intent", 1)
    damaged = path.read_bytes()

    def lacks_room(self, *_: object):
        raise sqlite3.OperationalError("database or disk is full")

    monkeypatch.setattr(
        recovery,
        "_read_events",
        lambda database, found: list(
            recovery._rows(mock.Mock(execute=lacks_room), found, "SELECT")
        ),
    )
    with pytest.raises(JournalError, match=r"not recovered and is unchanged.*full"):
        recover(path)
    assert path.read_bytes() == damaged


def test_all_hosts_must_report_before_work_is_assigned(path, recovered) -> None:
    """A recovered journal counts as after a power loss: its `boot` is empty."""
    spoil(path, "intent", 1)
    assert recovered().intents("cluster")["epoch"] == {"epoch": 4, "boot": "recovered"}


@pytest.mark.parametrize("table", ["application", "version", "mode"])
def test_one_damaged_intent_of_any_table_is_recovered(path, recovered, table) -> None:
    """The start that refuses the journal names the recovery, which must not refuse it too."""
    with contextlib.closing(sqlite3.connect(path)) as database, database:
        database.execute("INSERT INTO intent VALUES (?, 'a', 'no JSON')", (table,))
    assert recovered().intents(table) == {}


def test_a_whole_journal_is_left_alone(path) -> None:
    """`--recover` may stand in a start script."""
    before = path.read_bytes()
    with pytest.raises(JournalError, match="is not damaged: start without"):
        recover(path)
    assert path.read_bytes() == before


def test_where_nothing_can_be_read_nothing_is_changed(path) -> None:
    """The damaged file stays where it was."""
    path.write_bytes(b"this is no database at all, but text" * 1000)
    with pytest.raises(JournalError, match="has no readable part"):
        recover(path)
    assert [one.name for one in path.parent.iterdir()] == ["journal.sqlite"]


def test_a_missing_journal_is_reported(tmp_path) -> None:
    """The error has the path."""
    with pytest.raises(JournalError, match=str(tmp_path / "journal.sqlite")):
        recover(tmp_path / "journal.sqlite")
