"""Code map in the documentation: its names exist, and no package is missing."""

from __future__ import annotations

import re
import sys
from pathlib import Path

import pytest

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

ROOT = Path(__file__).resolve().parents[3]
PAGES = [*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")]
MAP = (ROOT / "docs/explanation/architecture.md").read_text(encoding="utf-8")


def tree(number: int) -> list[set[str]]:
    """Return the names of a drawn tree of folders, by group."""
    drawn = re.findall(r"^```text\n(.*?)^```", MAP, re.MULTILINE | re.DOTALL)[number]
    return [set(re.findall(r"^(\w+)(?:/|\.py) ", group, re.MULTILINE))
            for group in drawn.split("\n\n")]  # fmt: skip


def folders(path: str) -> set[str]:
    return {file.parent.name for file in (ROOT / path).glob("*/__init__.py")}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_every_source_file_that_is_named_exists(page: Path) -> None:
    """Paths are `rosrm/....py` or `plugins/....py`, with all their folders."""
    text = page.read_text(encoding="utf-8")
    named = re.findall(r"(?<![\w/.])(?:rosrm|plugins)/[\w/]+\.py\b", text)
    named += re.findall(r"`((?:rosrm|plugins)/[\w/]+/)`", text)
    assert [path for path in named if not (ROOT / path).exists()] == []


@pytest.mark.parametrize("path", ["a reading", "a submission", "a migration", "a handoff"])
def test_each_step_of_a_path_names_one_file(path: str) -> None:
    """Each step has a path and the action there, in order."""
    section = re.split(r"^## ", MAP.partition(f"## Path of {path}\n")[2], flags=re.MULTILINE)[0]
    steps = re.findall(r"^(\d+)\. (.*)$", section, re.MULTILINE)
    assert [int(number) for number, _ in steps] == [*range(1, len(steps) + 1)]
    assert len(steps) > 10
    for _, step in steps:
        assert re.match(r"`(rosrm|plugins)/[\w/]+\.py`: \S", step), step


def test_the_packages_of_the_map_are_those_of_the_layers() -> None:
    """The groups of the tree are the layers that import-linter checks; no package is missing."""
    contracts = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]
    (layers,) = (
        one["layers"]
        for one in contracts["contracts"]
        if one["name"] == "Packages import downwards only"
    )
    assert tree(0) == [set(re.findall(r"rosrm\.(\w+)", layer)) for layer in layers]
    assert folders("rosrm") <= set().union(*tree(0))


def test_the_map_has_every_folder_of_the_masters_core() -> None:
    """The second tree of the page has these folders."""
    assert set().union(*tree(1)) == folders("rosrm/core/master")
