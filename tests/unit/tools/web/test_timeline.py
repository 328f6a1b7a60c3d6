"""The picture of processes over hosts, from hand-made events."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from rosrm.model.rows import Listing, ProcessRow
from rosrm.timeline.reading import Timeline
from rosrm_web.page.timeline import MOST_BARS, MOST_ROWS, STYLES, Picture, View, picture
from rosrm_web.page.timeline_chart import COLOURS, fill, options
from tests.unit.tools.report.runs import BEGAN, events

#: The running process p, started on host a at second 10.
RUNS = ((0, "submitted", "p"), (10, "assigned", "p", "a"), (11, "running", "p", "a"))
MOVED = {"from": "a", "to": "b", "seconds": 1.0, "cause": "a is over", "strategy": "handoff"}


def process(name: str, state: str = "running", host: str = "a", **fields: Any) -> ProcessRow:
    return ProcessRow(
        name, "service", state, host, 1, 1, 0, 0, None, 0, 0, fields.pop("since", 5.0), 0.0, 0, "",
        **fields,
    )  # fmt: skip


def drawn(
    *lines: tuple, processes: Sequence[ProcessRow] = (), now: float = 60.0, **view: Any
) -> Picture:
    """Return the picture of a minute, at second 60 by default."""
    timeline = Timeline()
    for event in events(*lines):
        timeline.take(event)
    listing = Listing("m", now, len(lines), processes=processes)
    return picture(timeline, listing, View(**{"seconds": 60.0, **view}), now)


def ms(seconds: float) -> int:
    return round(1e3 * (BEGAN + seconds))


def styles(made: Picture) -> dict[str, str]:
    return {process: STYLES[int(style)] for _, _, _, style, process, _ in made.bars}


def test_a_running_process_is_a_bar_up_to_the_right_edge():
    """The lane of its host has a row for the name, and one for the bar."""
    made = drawn(*RUNS, processes=[process("p")])

    assert made.bars == [(ms(10), 0, 1, 0, "p", "on a: running")]
    assert made.lanes == [(0, 0, 2, 0, "", "a")]
    assert (made.rows, made.summary) == (2, "1 host, 1 process, no moves, no failures")


def test_a_bar_has_the_style_of_the_state_or_of_the_end_of_the_process():
    """The present state is that of the listing; only a failure differs from other ends."""
    made = drawn(
        *((number, "assigned", name, "a") for number, name in enumerate("abcdef")),
        (20, "failed", "e", "a"), (21, "finished", "f", "a"),
        processes=[
            process("a", "starting"), process("b", "migrating"), process("c", "unreachable"),
            process("d"), process("e", "failed"), process("f", "finished"),
        ],
    )  # fmt: skip

    assert list(styles(made).values()) == [
        "starting", "moving", "in trouble", "running", "failed", "ended",
    ]  # fmt: skip


def test_a_move_is_an_arrow_between_the_bars_and_a_row_of_the_table():
    """A screen reader reads from the table the same moves as the picture shows."""
    made = drawn(*RUNS, (30, "migrated", "p", "b", "", MOVED), processes=[process("p", host="b")])

    assert [bar[:3] for bar in made.bars] == [(ms(10), ms(30), 1), (ms(30), 0, 3)]
    assert made.moves == [(ms(30), 1, 3, 0, "p", "a to b, handoff: a is over")]
    (row,) = made.table.values()
    assert (row["time"], row["what"], row["process"]) == (BEGAN + 30, "moved", "p")
    assert (row["host"], row["message"]) == ("a to b", "handoff: a is over")


def test_a_migration_that_failed_has_no_arrow():
    """The table shows the migration with the reason."""
    made = drawn(*RUNS, (30, "stayed", "p", "a", "p stays: b is lost", MOVED))

    assert made.moves == []
    assert [row["what"] for row in made.table.values()] == ["stayed"]


def test_a_process_from_before_the_known_events_is_drawn():
    """The bar begins at the first known event at the latest; an ended process has no bar."""
    made = drawn(
        (0, "host_cordoned", "", "a"),
        processes=[process("p", since=90.0), process("q"), process("r", "failed")],
    )  # fmt: skip

    assert [(bar[0], bar[4]) for bar in made.bars] == [(ms(-30), "p"), (ms(0), "q")]


def test_lost_hosts_limits_and_failures_are_marked():
    """Each mark is at its time; a loss without an end lasts to the right edge."""
    made = drawn(
        *RUNS, (20, "over_limit", "", "a", "", {"resource": "memory"}),
        (25, "under_limit", "", "a"), (30, "failed", "p", "a", "exit code 1\ndetails"),
        (40, "host_lost", "", "a"),
    )  # fmt: skip

    assert made.failures == [(ms(30), 1, 0, 0, "p", "exit code 1")]
    assert made.spans == [
        (ms(40), 0, 0, 2, "", "a is lost"),
        (ms(20), ms(25), 2, 0, "", "a is over its limit of memory"),
    ]
    assert [row["what"] for row in made.table.values()] == ["over limit", "failed", "lost"]


def test_a_failure_without_a_host_is_only_in_the_table():
    """No host could start the process."""
    made = drawn(*RUNS, (20, "failed", "q", "", "q failed: no such program"))

    assert made.failures == []
    assert [row["message"] for row in made.table.values()] == ["q failed: no such program"]


def test_names_narrow_the_picture():
    """Parts of names are enough; lanes without a bar are left out."""
    lines = (
        *RUNS, (12, "assigned", "q", "b"), (13, "assigned", "r", "b"), (14, "failed", "r", "b"),
    )  # fmt: skip
    rows = [process("p", application="nav"), process("q", host="b"), process("r", "failed")]

    def shown(**view: str) -> tuple[list[str], list[str]]:
        made = drawn(*lines, processes=rows, **view)
        return [lane[5] for lane in made.lanes], [bar[4] for bar in made.bars]

    assert shown() == (["a", "b"], ["p", "q", "r"])
    assert shown(process="q") == (["b"], ["q"])
    assert shown(application="na") == (["a"], ["p"])
    assert shown(host="b") == (["b"], ["q", "r"])
    assert not drawn(*lines, processes=rows, process="q").failures


def test_a_look_back_shows_what_was_then():
    """Runs that began later are missing, and runs that have not ended are there."""
    lines = (*RUNS, (100, "assigned", "q", "b"))
    made = drawn(*lines, processes=[process("p"), process("q")], now=200.0, end=BEGAN + 70.0)

    assert [bar[4] for bar in made.bars] == ["p"]
    assert drawn(*lines, now=200.0, end=BEGAN + 9.0).bars == []


def test_a_look_back_stays_at_its_time_when_old_events_are_forgotten():
    """Seconds of the timeline count from its first event, which changes when events are dropped."""
    lines = (*RUNS, (100, "assigned", "q", "b"))

    for known, now in ((lines, 200.0), (lines[1:], 190.0)):
        made = drawn(*known, now=now, end=BEGAN + 95.0)
        assert [(bar[0], bar[4]) for bar in made.bars] == [(ms(10), "p")]


def test_a_bar_keeps_its_row_when_another_one_leaves_the_view():
    """Bars must not change their rows while the picture follows the cluster."""
    lines = (
        (0, "assigned", "old", "a"), (1, "assigned", "p", "a"), (5, "finished", "old", "a"),
        (6, "assigned", "q", "a"),
    )  # fmt: skip

    def rows(now: float) -> dict[str, float]:
        return {bar[4]: bar[2] for bar in drawn(*lines, now=now).bars}

    assert rows(60.0) == {"old": 1, "p": 2, "q": 1}
    assert rows(70.0) == {"p": 2, "q": 1}


def test_of_very_many_runs_the_longest_are_drawn():
    """The summary says how many are missing, and the table is bounded too."""
    count = MOST_BARS + 7
    lines = [(0, "assigned", f"p{number}", "a") for number in range(count)]
    lines += [(1 + number / count, "failed", f"p{number}", "a") for number in range(count)]
    made = drawn(*lines)

    assert len(made.bars) == MOST_BARS
    assert "7 short runs not drawn" in made.summary
    assert "p0" not in {bar[4] for bar in made.bars}
    assert len(made.table) == MOST_ROWS


def test_unprintable_characters_reach_no_table():
    """Messages come from other machines, which may send any text."""
    made = drawn(*RUNS, (30, "failed", "p", "a", "\x1b[31mexit code 1"))

    (row,) = made.table.values()
    assert row["message"] == "?[31mexit code 1"
    assert made.failures[0][5] == "?[31mexit code 1"


def test_the_options_have_the_shapes_of_a_picture():
    """A text beside the pointer is drawn as text: HTML in it would be read otherwise."""
    shown = options()
    made = drawn(*RUNS, processes=[process("p")])
    fill(shown, made)

    assert shown["tooltip"]["renderMode"] == "richText"
    assert {one["id"]: one["data"] for one in shown["series"]}["bars"] == made.bars
    assert len(COLOURS) == len(STYLES)
