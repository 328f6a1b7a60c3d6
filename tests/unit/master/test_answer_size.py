"""The size of a whole listing, however long the texts in its rows are."""

from __future__ import annotations

from dataclasses import replace

import pytest

from rosrm.master import answer_size
from rosrm.master.answer_size import short_applications, short_events, short_processes
from rosrm.model.applications import ApplicationRow
from rosrm.model.rows import EventRow, ProcessRow

MOST = 1000


@pytest.fixture(autouse=True)
def _small(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(answer_size, "_MOST", MOST)


def row(name: str, reason: str) -> ProcessRow:
    return ProcessRow(
        name, "job", "failed", "", 0, 0, 0, 0, 1, 50, 0, 0.0, 0.0, 0, reason
    )  # fmt: skip


@pytest.mark.parametrize("letter", ["x", "é", "😀", "\udcff"])
def test_the_longest_reasons_of_processes_are_cut(letter: str) -> None:
    """Those of other processes stay whole, and clients take the listing."""
    others = [row(f"p{number}", "exit code 1") for number in range(5)]
    long = [row(f"m{number}", letter * 4_000) for number in range(5)]
    rows = short_processes([*others, *long])
    assert list(rows[:5]) == others
    assert all(0 < len(one.reason) < 4_000 for one in rows[5:])
    assert sum(len(one.reason.encode()) for one in rows) <= MOST


def test_a_listing_that_fits_is_as_it_was() -> None:
    rows = [row("p", "x" * (MOST // 2)), row("q", "x" * (MOST // 2))]
    assert short_processes(rows) is rows


def test_the_longest_reasons_of_an_application_are_cut() -> None:
    """Also those of its processes."""
    long = ApplicationRow("a", "", "applying", 1, 9, 0, {f"p{n}": "x" * 900 for n in range(9)})
    (cut,) = short_applications([replace(long, reason="y" * 900)])
    assert set(cut.pending) == set(long.pending)
    assert sum(map(len, [cut.reason, *cut.pending.values()])) <= MOST


def test_long_messages_of_events_are_cut_and_their_largest_facts_left_out() -> None:
    small = EventRow(1, 0.0, 0.0, "failed", "p", "h", "exit code 1", {"code": 1})
    large = replace(small, message="x" * 900, facts={"tried": "y" * 900})
    rows = short_events([small, *[large] * 4])
    assert rows[0] == small
    assert sum(len(one.message) for one in rows) <= MOST
    assert [one.facts for one in rows[1:]] == [{}] * 4
