"""Page of the kinds of faults: each row names what prevents the kind, and tests that exist."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[3]
PAGE = ROOT / "docs/explanation/kinds-of-faults.md"
ROWS = [
    [cell.strip() for cell in line.strip("| \n").split(" | ")]
    for line in PAGE.read_text(encoding="utf-8").splitlines()
    if re.match(r"\| [^w]", line)
]


@pytest.mark.parametrize("row", ROWS, ids=lambda row: row[0][:40])
def test_each_row_names_what_exists(row: list[str]) -> None:
    """A module or a decision prevents the kind, and each test has its file and name."""
    _, prevents, tests = row
    paths = re.findall(r"`((?:rosrm|plugins|tools)\w*/[\w/.]+)`", prevents)
    assert paths or "../decisions/" in prevents
    assert [path for path in paths if not (ROOT / path).is_file()] == []
    named = re.findall(r"`([^`]+)`", tests)
    assert named
    for one in named:
        path, _, name = one.partition("::")
        text = (ROOT / "tests" / path).read_text(encoding="utf-8")
        assert f"def {name}(" in text or not name, one


def test_each_row_is_read() -> None:
    text = PAGE.read_text(encoding="utf-8")
    assert len(ROWS) == text.count("\n| ") - text.count("| what went wrong |")
    assert len({row[0] for row in ROWS}) == len(ROWS)
