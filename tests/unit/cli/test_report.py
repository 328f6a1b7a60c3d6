"""`rosrm report`: sources, files and errors."""

from __future__ import annotations

import json
import sqlite3
from contextlib import closing
from pathlib import Path

import pytest

from rosrm.journal.sqlite import SqliteJournal
from rosrm.model.event_kinds import EventKind
from rosrm.model.records import Intent, Record
from tests.unit.tools.report.runs import events
from tests.unit.tools.report.test_page import Page
from tests.unit.tools.simulate.workloads import host, plan, recorded, simulation

DATA = Path(__file__).parents[2] / "data" / "journal"
#: Events of one process that fails.
FAILED = [
    Record(EventKind.SUBMITTED, "p"), Record(EventKind.ASSIGNED, "p", "a", "", {"number": 3}),
    Record(EventKind.FAILED, "p", "a", "p failed on a: exit code 1"),
]  # fmt: skip


@pytest.fixture(scope="module")
def content() -> bytes:
    plans = [plan(f"p{n}", 100.0, at=float(n), duration=4.0, cpu=0.5) for n in range(6)]
    return recorded(simulation([host("a"), host("b")], plans, until=20.0))


@pytest.fixture(autouse=True)
def directory(tmp_path, monkeypatch):
    """Return the working directory, into which a report is written by default."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


def many(path: Path, count: int) -> None:
    """Write a journal with some events of as many processes as fill some pages."""
    with closing(SqliteJournal(path)) as journal:
        rows = [Record(EventKind.SUBMITTED, f"p{n}", "", "x" * 200) for n in range(count)]
        journal.write(rows, [Intent("host", "a", {"host_id": 1})], 0.0)
        journal.write(FAILED, [], 1.0)


def test_the_journal_of_an_older_master_gives_a_page(rosrm, directory):
    """Its state directory is enough; the page says that a journal has no readings."""
    rows = [json.loads(line) for line in (DATA / "rows.jsonl").read_text().splitlines()]
    with closing(sqlite3.connect(directory / "journal.sqlite")) as database, database:
        database.executescript((DATA / "schema.sql").read_text())
        for row in rows:
            if "record" in row:
                *plain, facts = row["record"]
                database.execute(
                    "INSERT INTO record VALUES (?,?,?,?,?,?,?,?)", (*plain, json.dumps(facts))
                )

    done = rosrm("report", ".", "--title", "The <night>")

    assert (done.code, done.err.splitlines()) == (
        0, ["The source has no readings, so the usage of the hosts is not shown."],
    )  # fmt: skip
    assert done.out.startswith("report.html: ")
    page = Page((directory / "report.html").read_text())
    cells = {one.strip() for one in page.texts}
    assert {"The <night>", "shelf", "moved", "handoff", "migration stuck"} <= cells


def test_a_record_has_the_usage_too(rosrm, directory, content):
    """Its events and readings have one scale of time."""
    (directory / "r.rosrec").write_bytes(content)
    (directory / "master").mkdir()
    many(directory / "master" / "journal.sqlite", 1)  # a record has more, so it is preferred

    made = json.loads(rosrm("report", directory, "--json").out)

    assert not (directory / "report.html").exists()
    assert {one["process"] for one in made["placements"]} == {f"p{n}" for n in range(6)}
    assert set(made["outcomes"].values()) == {"finished"}
    times, (first, *_) = made["readings"]["times"], made["placements"]
    curve = made["readings"]["usage"]["memory"][first["host"]]
    begins = next(at for at, used in zip(times, curve, strict=True) if used)
    assert first["begin"] <= begins <= first["begin"] + 2.0
    assert made["notes"] == []


def test_a_record_that_is_cut_short_gives_its_complete_part(rosrm, directory, content):
    """The page and standard error say so."""
    (directory / "r.rosrec").write_bytes(content[:-300])

    done = rosrm("report", "r.rosrec", "-o", "cut.html")

    said = "The record is cut short: the report has its complete part."
    assert (done.code, done.err) == (0, f"{said}\n")
    assert said in (directory / "cut.html").read_text()


def test_a_damaged_record_is_one_clear_error(rosrm, directory, content):
    """Nothing is written, and an older report stays."""
    (directory / "report.html").write_text("older")
    broken = bytearray(content)
    broken[len(broken) // 2] ^= 4
    (directory / "r.rosrec").write_bytes(broken)

    done = rosrm("report", "r.rosrec")

    assert done.code == 2
    assert "r.rosrec: the recording is damaged at byte" in done.err
    assert len(done.err.splitlines()) == 1
    assert (directory / "report.html").read_text() == "older"


def test_a_damaged_journal_gives_its_readable_part(rosrm, directory):
    """The journal itself is not changed."""
    path = directory / "journal.sqlite"
    many(path, 3000)
    broken = bytearray(path.read_bytes())
    middle = len(broken) // 2 // 4096 * 4096
    broken[middle : middle + 8192] = b"\xff" * 8192
    path.write_bytes(broken)

    done = rosrm("report", path, "--json")

    assert done.code == 0, done.err
    made = json.loads(done.out)
    assert "The journal is damaged: the report has its readable part." in made["notes"]
    assert 1000 < len(made["outcomes"]) < 3001
    assert made["outcomes"]["p"] == "failed"
    assert made["faults"] == []
    assert path.read_bytes() == bytes(broken)
    assert [one.name for one in directory.iterdir()] == ["journal.sqlite"]


def test_a_journal_without_a_readable_part_is_one_clear_error(rosrm, directory):
    """The error names the user's file."""
    path = directory / "journal.sqlite"
    path.write_bytes(b"SQLite format 3\0" + b"\xff" * 5000)

    done = rosrm("report", path)

    assert done.code == 1
    assert f"the journal {path}" in done.err
    assert "rosrm-report-" not in done.err


def test_the_journal_of_a_running_master_is_read(rosrm, directory):
    """With the events that are only in its write-ahead log, and without a change of its files."""
    path = directory / "journal.sqlite"
    with closing(SqliteJournal(path)) as journal:
        journal.write(FAILED, [], 1.0)
        before = {one.name: one.read_bytes() for one in directory.iterdir()}
        assert "journal.sqlite-wal" in before

        made = json.loads(rosrm("report", directory, "--json").out)

        assert made["outcomes"] == {"p": "failed"}
        assert {one.name: one.read_bytes() for one in directory.iterdir()} == before


def test_a_failure_has_the_last_lines_of_its_log(rosrm, directory):
    """They come from the supervisors below the directory; a demo has its samples beside."""
    rows = events(
        (0, "submitted", "p"), (1, "assigned", "p", "a", "", {"number": 3}),
        (2, "failed", "p", "a", "p failed on a: exit code 1"),
    )  # fmt: skip
    fields = ("sequence", "wall_time", "elapsed", "kind", "process", "host", "message", "facts")
    plain = [json.dumps({name: getattr(one, name) for name in fields}) for one in rows]
    (directory / "events.jsonl").write_text("\n".join([*plain, plain[0][:20]]))
    samples = {
        "hosts": ["a"], "limits": {"memory": 0.8},
        "samples": [{"elapsed": 1.5, "usage": {"memory": {"a": 0.25}}}],
    }  # fmt: skip
    (directory / "samples.json").write_text(json.dumps(samples))
    logs = directory / "cluster/hosts/a/supervisor/logs"
    logs.mkdir(parents=True)
    (logs / "p.3.log").write_text("".join(f"line {n}\n" for n in range(5000)) + "<b>boom\x1b[0m")

    done = rosrm("report", ".")

    assert done.err == "1 line of events.jsonl cannot be read.\n"
    page = (directory / "report.html").read_text()
    assert "&lt;b&gt;boom?[0m" in page
    assert "line 4981\n" in page
    assert "line 4980\n" not in page
    assert "a: at most 25 %" in page


@pytest.mark.parametrize(
    ("files", "said"),
    [
        ((), "no run is in it"),
        (("a/journal.sqlite", "b/journal.sqlite"), "has several runs; name one of them: "),
    ],
)
def test_a_directory_has_one_run(rosrm, directory, files, said):
    """Otherwise the error says what is searched for, or which there are."""
    for name in files:
        (directory / name).parent.mkdir()
        many(directory / name, 1)

    done = rosrm("report", directory)

    assert done.code == 2
    assert said in done.err


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("none.rosrec", "none.rosrec: cannot be read: No such file or directory"),
        ("notes.txt", "notes.txt: is neither a master's journal (journal.sqlite) nor"),
        ("journal.sqlite -o no/r.html", "--output no/r.html: cannot be written: No such file"),
    ],
)
def test_wrong_arguments_are_one_clear_error(rosrm, directory, words, said):
    """No source, another file, no directory for the output."""
    (directory / "notes.txt").write_text("hello")
    many(directory / "journal.sqlite", 1)

    done = rosrm("report", *words.split())

    assert done.code == 2
    assert said in done.err
    assert not list(directory.glob("*.html"))
