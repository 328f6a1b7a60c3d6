"""SQLite journal: acknowledged writes survive any death; an error names the remedy."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import sqlite3
import subprocess
import sys
import textwrap

import pytest

from rosrm.errors import JournalBlocked, JournalError
from rosrm.journal.errors import fault_of
from rosrm.journal.sqlite import SqliteJournal
from rosrm.model.event_kinds import EventKind
from rosrm.model.records import Intent, Record


@pytest.fixture
def path(tmp_path):
    return tmp_path / "state" / "journal.sqlite"


@pytest.fixture
def opened(path):
    """Return a function that opens the journal; it is closed at the end of the test."""
    with contextlib.ExitStack() as stack:

        def open_(**options) -> SqliteJournal:
            return stack.enter_context(contextlib.closing(SqliteJournal(path, **options)))

        yield open_


@pytest.fixture
def mounted(tmp_path):
    """Return a function that mounts a file system in memory on a folder."""
    disk = tmp_path / "disk"
    disk.mkdir()

    def mount(*options):
        words = ["mount", "-t", "tmpfs", *options, "tmpfs", disk]
        done = subprocess.run(words, capture_output=True, check=False)
        if done.returncode:
            pytest.skip(f"cannot mount here: {done.stderr.decode()}")
        return disk

    yield mount
    subprocess.run(["umount", "-l", disk], check=False, stderr=subprocess.DEVNULL)


def fill(path, count=3) -> None:
    with contextlib.closing(SqliteJournal(path)) as journal:
        for number in range(count):
            journal.write([Record("n", str(number))], [Intent("process", "p", {"n": number})], 0.0)


def run(code: str, path, **options) -> subprocess.Popen:
    """Start a process that uses the journal."""
    code = textwrap.dedent(code)
    return subprocess.Popen(
        [sys.executable, "-c", code, str(path)], stdout=subprocess.PIPE, text=True, **options
    )


WRITER = """
    import sys
    from pathlib import Path
    from rosrm.journal.sqlite import SqliteJournal
    from rosrm.model.records import Intent, Record

    journal = SqliteJournal(Path(sys.argv[1]))
    number = 0
    while True:
        number += 1
        journal.write(
            [Record("n", str(number), facts={"number": number}), Record("second", str(number))],
            [Intent("process", "p", {"n": number}), Intent("host", str(number % 7), {})],
            0.0,
        )
        print(number, flush=True)
"""


@pytest.mark.parametrize("after", [1, 7, 150, 1200])
def test_sigkill_loses_nothing_that_was_answered(path, opened, after) -> None:
    """Every acknowledged write is complete; an unacknowledged one is complete or absent."""
    writer = run(WRITER, path)
    for _ in range(after):
        answered = int(writer.stdout.readline())
    writer.send_signal(signal.SIGKILL)
    rest = writer.stdout.read()
    writer.wait(30)
    if lines := rest.split("\n")[:-1]:
        answered = int(lines[-1])

    journal = opened()
    records = journal.records(newest=10**6)
    last = journal.intents("process")["p"]["n"]

    assert answered <= last <= answered + 1
    assert [r.sequence for r in records] == list(range(1, 2 * last + 1))
    assert [r.record.kind for r in records[-2:]] == ["n", "second"]
    assert records[-1].record.process == str(last)


def test_a_group_is_whole_or_not_at_all(opened) -> None:
    """A group with an invalid value changes nothing, and the next group is written."""
    journal = opened()
    journal.write([Record("a")], [Intent("host", "h", {"n": 1})], 0.0)
    with pytest.raises(TypeError, match="no JSON"):
        journal.write([Record("b")], [Intent("host", "h", {"n": object()})], 0.0)
    stored = journal.write([Record("c")], [], 0.0)
    assert [s.sequence for s in stored] == [2]
    assert [s.record.kind for s in journal.records()] == ["a", "c"]
    assert journal.intents("host") == {"h": {"n": 1}}


def change(path, *statements: str) -> None:
    """Execute statements on the file, without rosrm."""
    with sqlite3.connect(path) as database:
        for statement in statements:
            database.execute(statement)


INDEX = (
    "UPDATE sqlite_schema SET sql = replace(sql, '(process)', '(host)') "
    "WHERE name = 'record_process'"
)


@pytest.mark.parametrize(
    "spoil",
    [
        lambda raw: b"this is no database at all, but text" * 100,
        lambda raw: raw[:4096] + os.urandom(4096) + raw[2 * 4096 :],
        lambda raw: raw[:5000],
        lambda raw: b"",
        ("UPDATE intent SET value = '{'",),
        ("PRAGMA writable_schema = ON", INDEX),
    ],
    ids=["header", "middle", "end", "all", "value", "index"],
)
def test_a_damaged_file_is_refused(path, spoil) -> None:
    """The error has its path and the remedy; the file is not changed or taken for an empty one."""
    fill(path, 200)
    if isinstance(spoil, tuple):
        change(path, *spoil)
    else:
        path.write_bytes(spoil(path.read_bytes()))
    before = path.read_bytes()

    with pytest.raises(JournalError) as refusal:
        SqliteJournal(path).intents("process")

    assert str(path) in str(refusal.value)
    assert "move it away" in str(refusal.value)
    assert path.read_bytes() == before


def test_a_damaged_log_costs_what_is_behind_the_damage(path, opened) -> None:
    """SQLite raises no error; only the number of the newest record reveals the loss."""
    writer = run(WRITER, path)
    for _ in range(20):
        answered = int(writer.stdout.readline())
    writer.kill()
    writer.wait(30)
    # a busy machine may have let the writer continue
    answered += sum(line.endswith("\n") for line in writer.stdout)
    writer.stdout.close()
    log = path.with_name("journal.sqlite-wal")
    raw = bytearray(log.read_bytes())
    raw[len(raw) // 2 :] = os.urandom(len(raw) - len(raw) // 2)
    log.write_bytes(raw)

    journal = opened()
    last = journal.intents("process")["p"]["n"]
    assert 0 < last < answered
    assert journal.last_sequence == 2 * last


def test_a_new_journal_takes_nothing_of_what_a_cut_start_and_a_former_one_left(path) -> None:
    """Also the log of a journal that was moved away without it is not read."""
    writer = run(WRITER, path)
    writer.stdout.readline()
    writer.kill()
    writer.wait(30)
    writer.stdout.close()
    assert path.with_name("journal.sqlite-wal").stat().st_size
    path.unlink()
    path.with_name("journal.sqlite.new").write_bytes(os.urandom(5000))

    with contextlib.closing(SqliteJournal(path)) as journal:
        assert journal.last_sequence == 0
        journal.write([Record("a")], [], 0.0)
    assert not path.with_name("journal.sqlite.new").exists()


def test_an_occupied_path_of_the_write_ahead_log_is_reported(path) -> None:
    """The log's path is occupied, and the message names it."""
    fill(path)
    path.with_name("journal.sqlite-wal").mkdir()
    with pytest.raises(JournalError, match="-wal"):
        SqliteJournal(path)


@pytest.mark.skipif(os.geteuid() != 0, reason="only root may mount a file system")
def test_a_read_only_file_system_is_reported(mounted) -> None:
    """The message has the path and the remedy, and claims no damage."""
    disk = mounted()
    fill(disk / "journal.sqlite")
    subprocess.run(["mount", "-o", "remount,ro", disk], check=True)
    with pytest.raises(JournalBlocked, match="check owner and permissions"):
        SqliteJournal(disk / "journal.sqlite").write([Record("a")], [], 0.0)


def test_another_version_is_refused(path) -> None:
    """A file of a later version of rosrm is not misread."""
    fill(path)
    change(path, "PRAGMA user_version = 99")
    with pytest.raises(JournalError, match="tables 99, here 1"):
        SqliteJournal(path)


def test_a_foreign_database_is_refused(path) -> None:
    """The file of another program is not changed."""
    path.parent.mkdir()
    change(path, "CREATE TABLE record (something INTEGER)")
    with pytest.raises(JournalError, match="database of another program"):
        SqliteJournal(path)


def test_a_locked_file_is_refused(path) -> None:
    """The error comes within seconds, and names the way to find the other writer."""
    fill(path)
    holder = sqlite3.connect(path, isolation_level=None)
    holder.execute("BEGIN EXCLUSIVE")
    with pytest.raises(JournalError, match="another program has it open"):
        SqliteJournal(path).write([Record("a")], [], 0.0)
    holder.close()


@pytest.mark.parametrize("name", ["", "journal.sqlite", "journal.sqlite-wal"])
def test_nothing_is_acknowledged_that_a_removed_journal_would_lose(path, opened, name) -> None:
    """SQLite itself writes on; once the file is back at its place, the journal continues."""
    journal = opened()
    journal.write([Record("kept")], [], 0.0)
    place, aside = path.parent / name, path.parent.with_name("aside")
    place.rename(aside)
    for _ in range(2):
        with pytest.raises(JournalBlocked, match="was removed or replaced while the master runs"):
            journal.write([Record("late")], [], 1.0)
    aside.rename(place)
    journal.write([Record("late")], [], 2.0)
    assert [one.record.kind for one in journal.records()] == ["kept", "late"]


def test_a_full_disk_is_reported(path, opened) -> None:
    """Acknowledged writes stay; the message has the full disk and the remedy."""
    code = """
        import json, resource, sys
        from pathlib import Path
        from rosrm.errors import JournalError
        from rosrm.journal.sqlite import SqliteJournal
        from rosrm.model.records import Intent, Record

        journal = SqliteJournal(Path(sys.argv[1]))
        resource.setrlimit(resource.RLIMIT_FSIZE, (200_000, 200_000))
        answered = 0
        try:
            while answered < 10_000:
                intent = Intent("a", "b", {"n": answered + 1})
                journal.write([Record("n", "x" * 500)], [intent], 0.0)
                answered += 1
        except JournalError as error:
            print(json.dumps([answered, str(error)]))
    """
    writer = run(code, path)
    output, _ = writer.communicate(timeout=60)
    answered, message = json.loads(output)

    assert str(path) in message
    assert "make room" in message
    assert "damaged" not in message
    journal = opened()
    assert journal.intents("a") == {"b": {"n": answered}}
    assert journal.last_sequence == answered


@pytest.mark.skipif(os.geteuid() != 0, reason="only root may mount a small file system")
def test_a_full_file_system_is_reported(mounted) -> None:
    """The error has the file system, and writes succeed again once there is room.

    The group that failed is then written unchanged, and its numbers have no gap.
    """
    disk = mounted("-o", "size=400k")
    answered = []

    def fill_up(journal) -> None:
        for number in range(10_000):
            journal.write([Record("n", "x" * 500)], [Intent("a", "b", {"n": number})], 0.0)
            answered.append(number)

    (disk / "filler").write_bytes(bytes(100_000))
    journal = SqliteJournal(disk / "journal.sqlite")
    free = rf"the disk is full \(the file system {disk} has \d.* free of 400 KiB\): make room"
    for _ in range(3):
        with pytest.raises(JournalBlocked, match=free):
            fill_up(journal)
    count = len(answered)
    assert journal.intents("a") == {"b": {"n": answered[-1]}}
    assert journal.last_sequence == count
    (disk / "filler").unlink()
    journal.write([Record("at last")], [Intent("a", "b", {"n": -1})], 0.0)
    assert journal.intents("a") == {"b": {"n": -1}}
    assert [one.sequence for one in journal.records(newest=10**6)] == [*range(1, count + 2)]
    journal._database.close()


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_a_folder_that_cannot_be_written_is_reported(tmp_path) -> None:
    """The error has the path."""
    tmp_path.chmod(0o500)
    with pytest.raises(JournalError, match=r"journal\.sqlite"):
        SqliteJournal(tmp_path / "state" / "journal.sqlite")


def test_an_invalid_path_is_reported(tmp_path) -> None:
    """The path is a file in place of the folder, or a folder in place of the file."""
    (tmp_path / "file").write_text("")
    (tmp_path / "folder.sqlite").mkdir()
    for path in (tmp_path / "file" / "journal.sqlite", tmp_path / "folder.sqlite"):
        with pytest.raises(JournalError, match=str(path)):
            SqliteJournal(path)


def test_old_events_are_pruned(opened) -> None:
    """The newest events are kept, and their numbers continue after a restart."""
    journal = opened(keep_events=50)
    for _ in range(25):
        journal.write([Record("n")] * 100, [], 0.0)
    kept = journal.records(newest=10**6)
    assert kept[-1].sequence == 2500
    assert 50 <= len(kept) <= 50 + 1000
    journal.close()
    assert opened(keep_events=50).last_sequence == 2500


def test_the_events_of_many_short_runs_are_pruned(opened) -> None:
    for _ in range(5):
        with contextlib.closing(opened(keep_events=50)) as journal:
            journal.write([Record("n")] * 100, [], 0.0)
    assert len(opened().records(newest=10**6)) == 50


def test_damaged_facts_of_an_event_hide_no_other(path, opened) -> None:
    """Facts are information for users only, and the event shows the damage."""
    fill(path)
    change(path, "UPDATE record SET facts = '{' WHERE sequence = 2")
    assert [one.record.facts for one in opened().records()] == [{}, {"unreadable": "{"}, {}]


def test_pruning_that_fails_fails_no_write(opened) -> None:
    """The write itself succeeded, and a retry would write it twice."""
    journal = opened(keep_events=0)
    journal._database.execute(
        "CREATE TRIGGER t BEFORE DELETE ON record BEGIN SELECT raise(ABORT, 'disk is full'); END"
    )
    stored = journal.write([Record("n")] * 1000, [], 0.0)
    assert len(stored) == len(journal.records(newest=10**6)) == 1000


def test_the_folder_is_private(path) -> None:
    """Specs may hold secrets in their environment: other users read nothing."""
    fill(path)
    assert path.parent.stat().st_mode & 0o077 == 0


def test_full_sync_works_the_same(opened) -> None:
    """`sync: full` flushes to the disk with every group."""
    journal = opened(sync="full")
    journal.write([Record("a")], [], 0.0)
    assert journal._database.execute("PRAGMA synchronous").fetchone() == (2,)


def test_a_journal_is_private_also_in_a_directory_that_existed(tmp_path):
    """Its intents hold the environment of each process, and so passwords."""
    tmp_path.chmod(0o755)
    before = os.umask(0o022)
    try:
        journal = SqliteJournal(tmp_path / "journal.sqlite")
        journal.write([], [Intent("process", "p", {"environment": {"API_TOKEN": "x"}})], 0.0)
        files = sorted(path.name for path in tmp_path.iterdir())
        modes = {path.stat().st_mode & 0o777 for path in tmp_path.iterdir()}
        journal.close()
    finally:
        os.umask(before)
    assert files == ["journal.sqlite", "journal.sqlite-shm", "journal.sqlite-wal"]
    assert modes == {0o600}
    assert tmp_path.stat().st_mode & 0o777 == 0o700


def test_a_journal_of_an_earlier_release_becomes_private(tmp_path):
    SqliteJournal(tmp_path / "journal.sqlite").close()
    (tmp_path / "journal.sqlite").chmod(0o644)
    SqliteJournal(tmp_path / "journal.sqlite").close()
    assert (tmp_path / "journal.sqlite").stat().st_mode & 0o777 == 0o600


def test_a_journal_that_is_a_link_is_refused(tmp_path):
    (tmp_path / "elsewhere").touch()
    (tmp_path / "journal.sqlite").symlink_to("elsewhere")
    with pytest.raises(JournalError, match="it is a symbolic link"):
        SqliteJournal(tmp_path / "journal.sqlite")


def size_of(journal) -> int:
    return sum(len(one.record.message) for one in journal.records(newest=10**6))


def test_old_events_are_pruned_by_their_bytes(path, opened) -> None:
    """Ten thousand long messages fill no disk, and neither does the write-ahead log."""
    journal = opened(keep_bytes=1_000_000)
    for _ in range(300):
        journal.write([Record("n", message="x" * 10_000)] * 10, [], 0.0)
    kept = journal.records(newest=10**6)
    assert 900_000 < size_of(journal) <= 1_000_000
    assert kept[-1].sequence == 3000
    assert sum(file.stat().st_size for file in path.parent.iterdir()) < 8_000_000
    journal.close()
    assert 900_000 < size_of(opened(keep_bytes=1_000_000)) <= 1_000_000


def test_one_event_larger_than_the_bound_is_kept(opened) -> None:
    """The newest event holds the number at which the next master continues."""
    journal = opened(keep_bytes=1_000_000)
    journal.write([Record("n")], [], 0.0)
    journal.write([Record("n", message="x" * 2_000_000)], [], 0.0)
    assert [one.sequence for one in journal.records()] == [2]
    journal.close()
    assert opened(keep_bytes=1_000_000).last_sequence == 2


@pytest.mark.parametrize("long", ["", "x" * 1000])
@pytest.mark.parametrize(
    "kind", [EventKind.PEER_REFUSED, EventKind.HOST_REFUSED, EventKind.READING_REFUSED]
)
def test_a_flood_of_refusals_does_not_wipe_the_audit_trail(opened, kind, long) -> None:
    """Anybody can cause refusals: they get a tenth of the record."""
    journal = opened(keep_events=5000, keep_bytes=5_000_000)
    trail = [Record(EventKind.SUBMITTED, f"p{number}") for number in range(1000)]
    journal.write(trail, [], 0.0)
    for _ in range(200):
        journal.write([Record(kind, message=f"a host was refused{long}")] * 100, [], 0.0)
    kept = journal.records(newest=10**6)
    submitted = [one for one in kept if one.record.kind is EventKind.SUBMITTED]
    assert len(submitted) == 1000
    assert 400 <= len(kept) - 1000 <= 1500 + 100
    assert journal.last_sequence == 21_000


@pytest.mark.parametrize(
    "fault",
    [
        sqlite3.OperationalError("database or disk is full"),
        sqlite3.OperationalError("disk I/O error"),
        sqlite3.OperationalError("unable to open database file"),
        sqlite3.OperationalError("database is locked"),
        PermissionError(13, "Permission denied", "/home/ada/state/journal.sqlite"),
    ],
)
def test_clients_read_the_cause_of_a_stall_without_a_path(tmp_path, fault) -> None:
    """Everybody may ask the master; who started it needs the path."""
    error = fault_of(tmp_path / "journal.sqlite", fault)
    assert isinstance(error, JournalBlocked)
    assert str(tmp_path) in str(error)
    assert str(tmp_path) not in error.public
    assert "/home" not in error.public
    assert error.public.startswith("the journal of the master cannot be used (")


def test_a_journal_in_a_directory_that_refuses_a_look_is_blocked_and_no_crash(
    tmp_path, monkeypatch
) -> None:
    """The fault concerns the path, so its description must not depend on a look at the path."""

    def refuse(*_, **__):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(os, "stat", refuse)
    error = fault_of(tmp_path / "j.sqlite", sqlite3.OperationalError("unable to open database"))
    assert isinstance(error, JournalBlocked)
    assert "check owner and permissions" in str(error)


def test_only_the_answered_groups_are_moved_out_of_the_log(path, opened) -> None:
    """A checkpoint waits for the disk, so no commit makes one. The log stays within its bound."""
    journal = opened()
    log, empty = path.with_name("journal.sqlite-wal"), path.stat().st_size
    values = iter(range(1000))

    def commit() -> None:
        number = next(values)
        intent = Intent("process", f"p{number}", {"x": "y" * 200_000})
        journal.commit(journal.render([], [intent], 0.0))

    while not journal.is_untidy:
        commit()
    assert log.stat().st_size > 4 << 20
    assert path.stat().st_size == empty
    journal.tidy()
    assert path.stat().st_size > 3 << 20
    commit()
    assert not journal.is_untidy
    assert log.stat().st_size == 4 << 20
