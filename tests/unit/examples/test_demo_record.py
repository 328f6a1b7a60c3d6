"""Record of a demo: its files, figures, picture and lines."""

from __future__ import annotations

import io
import json
import math

import pytest
from rich.console import Console

from rosrm.model.rows import EventRow, HostRow, Listing, ProcessRow, ResourceRow
from rosrm.model.values import HostDescription
from rosrm_examples import demo_plots
from rosrm_examples.demo_plots import draw_usage, memory_of, stacked, title_of
from rosrm_examples.demo_record import Record, Sample, sample_of, summarise
from rosrm_examples.demo_screen import LineScreen, line_of, note_of

HOSTS = ("host1", "host2")


def process(name, state, host=""):
    return ProcessRow(
        name=name, kind="job", state=state, host=host, number=1, pid=1, restarts=0, migrations=0,
        exit_code=0, priority=0, queue_position=int(state == "queued"), since=1.0, cpu=0.0,
        memory=0, reason="",
    )  # fmt: skip


def host(name, usage, *, stale=False):
    memory = ResourceRow("memory", "B", 1e9, "slice", usage, 0.0, 0.8, stale)
    return HostRow(HostDescription(name, 1), 1, "up", False, False, True, 0.0, (memory,), 0)


def view(*processes, events=(), usage=(0.25, 0.5)):
    hosts = [host(name, value) for name, value in zip(HOSTS, usage, strict=True)]
    return Listing("demo", 12.5, 7, hosts=hosts, processes=processes, events=events)


def event(sequence, elapsed, kind, name="", on="", **facts):
    return EventRow(sequence, 1e9 + elapsed, elapsed, kind, name, on, f"{name} {kind}", facts)


@pytest.fixture
def record():
    """Return a record with one piece, and one holder that moves from host1 to host2."""
    made = Record(HOSTS, {"memory": 0.8}, budget=1000)
    made.events = [
        event(1, 2.0, "submitted", "piece_01"),
        event(2, 2.1, "submitted", "holder_01"),
        event(3, 2.2, "assigned", "piece_01", "host2", number=1),
        event(4, 2.3, "assigned", "holder_01", "host1", number=2),
        event(5, 5.0, "over_limit", "", "host1", resource="memory"),
        event(6, 6.0, "migration_begun", "holder_01", "host2", source=2, destination=3),
        event(7, 6.5, "migrated", "holder_01", "host2", **{"from": "host1", "to": "host2"}),
        event(8, 7.0, "finished", "piece_01", "host2"),
        event(9, 9.5, "finished", "holder_01", "host2"),
    ]
    made.samples = [
        Sample(2.0 + step, {"memory": {"host1": 0.1 * step, "host2": None}}, 1, step % 3)
        for step in range(9)
    ]
    return made


# --- the record ---------------------------------------------------------------------------------


def test_a_sample_has_what_is_known_and_null_for_what_is_not():
    seen = sample_of(view(process("a", "running"), process("b", "queued"), usage=(0.25, math.nan)))
    assert seen == Sample(12.5, {"memory": {"host1": 0.25, "host2": None}}, running=1, waiting=1)
    stale = Listing("demo", 1.0, 0, hosts=[host("host1", 0.5, stale=True)])
    assert sample_of(stale).usage == {"memory": {"host1": None}}


def test_a_view_adds_a_sample_and_its_events():
    record = Record(HOSTS, {"memory": 0.8}, 1000)
    assert record.last_sequence == 0
    record.add(view(events=[event(1, 1.0, "submitted", "a")]))
    record.add(view(events=[event(2, 2.0, "assigned", "a", "host1", number=1)]))
    assert (len(record.samples), record.last_sequence, record.start) == (2, 2, 1.0)


def test_the_files_hold_all_of_it(record, tmp_path):
    record.write(tmp_path)
    again = Record.read(tmp_path)
    assert again == record
    lines = (tmp_path / "events.jsonl").read_text().splitlines()
    assert [json.loads(line)["sequence"] for line in lines] == list(range(1, 10))


def test_the_instance_that_owned_a_process_last(record):
    assert record.last_instance("piece_01") == ("host2", 1)
    assert record.last_instance("holder_01") == ("host2", 3)
    assert record.last_instance("nobody") is None
    del record.events[6:]  # the move has not ended
    assert record.last_instance("holder_01") == ("host1", 2)


def test_the_summary(record):
    rows = [process("piece_01", "finished"), process("holder_01", "finished")]
    summary = summarise(record, rows, {"map_points": 5, "end_error_percent": 0.5})
    assert summary["processes"] == {"submitted": 2, "finished": 2, "failed": 0, "cancelled": 0}
    assert (summary["hosts"], summary["assignments"], summary["migrations"]) == (2, 2, 1)
    assert (summary["makespan_s"], summary["map_makespan_s"]) == (7.5, 5.0)
    assert (summary["map_points"], summary["end_error_percent"]) == (5, 0.5)
    assert summary["per_host"]["host1"] == {
        "assignments": 1, "migrations_from": 1, "migrations_to": 0, "peak_memory_percent": 80.0,
    }  # fmt: skip
    assert summary["per_host"]["host2"]["peak_memory_percent"] == 0.0


def test_the_summary_of_nothing():
    summary = summarise(Record(HOSTS, {"memory": 0.8}, 1000), [], {})
    assert (summary["assignments"], summary["makespan_s"]) == (0, 0.0)


# --- the picture --------------------------------------------------------------------------------


def test_the_picture_is_drawn(record, tmp_path):
    draw_usage(tmp_path / "usage.png", record, title_of(record))
    assert (tmp_path / "usage.png").read_bytes().startswith(b"\x89PNG")
    assert title_of(record) == "2 processes on 2 hosts of 0 MiB, migrations: 1"


def test_it_is_drawn_anew_from_the_files(record, tmp_path, capsys):
    record.write(tmp_path)
    assert demo_plots.main([str(tmp_path)]) == 0
    assert (tmp_path / "usage.png").exists()
    assert demo_plots.main([str(tmp_path / "nowhere")]) == 2
    assert "no record of a demo" in capsys.readouterr().err


def test_usage_in_percent_and_nan_where_it_is_not_known(record):
    assert memory_of(record, "host1")[:3] == pytest.approx([0.0, 10.0, 20.0])
    assert all(math.isnan(value) for value in memory_of(record, "host2"))


def test_marks_that_come_together_stand_in_rows():
    assert stacked([]) == []
    assert stacked([0.0, 0.1, 0.2, 1.0, 5.0, 5.3]) == [0, 1, 2, 0, 0, 1]


# --- the screen ---------------------------------------------------------------------------------


def test_a_line_says_how_it_stands():
    rows = [
        process("piece_01", "running"), process("holder_01", "starting"),
        process("holder_02", "running"), process("holder_03", "queued"),
        process("holder_04", "finished"),
    ]  # fmt: skip
    line = line_of(view(*rows))
    assert line == "memory  25  50 %   1 piece and 2 holders run, 1 wait, 1 finished"
    assert line_of(view(process("recorder", "running"))).endswith(
        "1 recorder runs, 0 wait, 0 finished"
    )
    assert "nothing runs" in line_of(view())


def test_lines_come_seldom_and_migrations_at_once():
    output = io.StringIO()
    screen = LineScreen(Console(file=output, width=40), line_of)
    begun = event(1, 0.5, "migration_begun", "holder_01", "host2")
    for elapsed in (0.0, 0.2, 0.4):
        screen.show(view(), elapsed)
    screen.show(view(events=[begun]), 0.6)
    screen.show(view(), 3.1)
    screen.close()
    lines = output.getvalue().splitlines()
    assert [line.split()[0] for line in lines] == ["0", "holder_01", "3"]


def test_the_note_tells_the_act():
    assert "mapped" in note_of(view(process("piece_01", "running")))
    assert "full" in note_of(view(process("holder_01", "queued")))
    assert "recorder" in note_of(view(process("recorder", "running")))
    assert note_of(view()) == ""


def test_a_failed_demo_names_the_last_problem():
    """A wrong number of handoffs alone would not say why one is missing."""
    record = Record((), {}, 0)
    assert record.last_problem() == ""
    for number, (kind, message) in enumerate((
        ("stayed", "slam stays on robot: it took longer than 10 s"),
        ("application_failed", "mapping is degraded: slam: switching took longer than 10 s"),
        ("migrated", "slam moved"),
    )):  # fmt: skip
        record.events.append(EventRow(number, 1e9, 0.0, kind, "slam", "robot", message))
    assert record.last_problem() == (
        "; the last problem: mapping is degraded: slam: switching took longer than 10 s"
    )
