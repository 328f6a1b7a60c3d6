"""The page of limits: its tables have the bounds that are in force."""

from __future__ import annotations

import re
from pathlib import Path

from rosrm.core.master.lifecycle import _LARGEST_STATUS, _MOST_STRAYS
from rosrm.core.master.stores import MOST_OF_USER
from rosrm.model.description_checks import LARGEST_DESCRIPTION
from rosrm.model.ledger import BOUNDS, Amount

PAGE = Path(__file__).parents[3] / "docs" / "reference" / "limits.md"


def shown(amount: Amount) -> str:
    size = f", {amount.size // 2**20} MiB" if amount.size else ""
    return f"{amount.number:,} entries{size}"


def test_the_table_has_every_store() -> None:
    """The table has the names and bounds by role of the ledger."""
    rows = re.findall(r"^\| ([a-z ]+) \| (\d.*?) \| (\d.*?) \|", PAGE.read_text(), re.MULTILINE)
    expected = [(store.value, shown(user), shown(root)) for store, (user, root) in BOUNDS.items()]
    assert [row for row in rows if "entries" in row[1]] == expected


def test_the_bounds_of_hosts_are_those_in_force() -> None:
    """The page names them as numbers."""
    text = PAGE.read_text()
    for number in (LARGEST_DESCRIPTION, _MOST_STRAYS, _LARGEST_STATUS):
        assert f"{number:,}" in text
    assert f"{MOST_OF_USER:.0%}".replace("%", " %") in text
