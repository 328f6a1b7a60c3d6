"""Kinds of events: their reference page, and their use in the code."""

from __future__ import annotations

import re
from pathlib import Path

from rosrm.model.event_kinds import EventKind
from scripts.event_table import PAGE, with_table

SOURCES = Path(__file__).parents[3] / "rosrm"


def test_the_reference_page_has_the_table_of_the_kinds() -> None:
    """`python scripts/event_table.py` writes the table; every kind has a meaning."""
    assert PAGE.read_text() == with_table(PAGE.read_text())
    assert all(kind.meaning for kind in EventKind)


def test_every_kind_is_recorded_somewhere() -> None:
    """A kind that no code names is dead, and leaves the table."""
    files = (
        file for part in ("core", "master", "journal") for file in (SOURCES / part).rglob("*.py")
    )
    named = {
        name for file in files for name in re.findall(r"EventKind\.([A-Z_]+)", file.read_text())
    }
    assert named == set(EventKind.__members__)


def test_a_kind_is_its_text() -> None:
    """JSON, messages and comparisons use the text of the kind; arbitrary text is no kind."""
    assert f"{EventKind.HOST_LOST}" == "host_lost" == EventKind.HOST_LOST
    assert {"host_lost": 1}[EventKind.HOST_LOST] == 1
    assert EventKind.read("host_lost") is EventKind.HOST_LOST


def test_a_kind_of_another_version_is_read() -> None:
    """Its event is shown with the text of the journal."""
    kind = EventKind.read("kind_of_tomorrow")
    assert (kind, kind.value, kind.meaning) == ("kind_of_tomorrow", "kind_of_tomorrow", "")
    assert "kind_of_tomorrow" not in EventKind.__members__.values()
