"""Entry of a work file for a process that runs: what its restarts and moves start."""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple

from rosrm.cli.adoption.environment import DOMAIN, variables_of
from rosrm.cli.adoption.facts import ProcessFacts
from rosrm.cli.adoption.ros_words import RosWords
from rosrm.errors import LaunchError
from rosrm.model.rows import PluginRow
from rosrm.slave.launch.ament_index import find_executable, search_path
from rosrm.supervisor.spawn import find_executable as on_path
from rosrm.supervisor.spawn_error import SpawnError

_PYTHON: Final = re.compile(r"python[0-9.]*")
#: Migration strategy that starts the program again, which any program allows.
_RELAUNCH: Final = "relaunch"


class Entry(NamedTuple):
    """The entry for a process.

    Attributes:
        keys: as in a work file.
        left: names of variables that are not taken.
        directory: its working directory, if that is not taken; "": it is.
    """

    keys: dict[str, Any]
    left: list[str]
    directory: str


def entry_of(
    facts: ProcessFacts, name: str, host: Mapping[str, str], *, moves: bool = True
) -> Entry:
    """Return the entry for a process.

    Args:
        facts: of the process.
        name: that it gets.
        host: environment that its host gives to processes.
        moves: the cluster has the strategy `relaunch`, the only one for a run without a handoff.
    """
    program, words = _program(facts)
    ros = RosWords(words, facts.directory)
    variables = variables_of(facts.environment, host)
    keys: dict[str, Any] = {"name": name, **program}
    if ros.arguments:
        keys["arguments"] = ros.arguments
    if "package" in program or ros.has_ros or facts.has_ros:
        keys |= {"node_name": "keep", **ros.keys}
        if "package" not in program:
            keys["ros"] = True
        if DOMAIN in variables.taken:  # the host does not see its graph
            keys["readiness"] = "running"
    if variables.taken:
        keys["environment"] = variables.taken
    # An executable of a package is found on other hosts, too, which may not have the directory.
    takes_directory = "package" not in program
    if takes_directory:
        keys["working_directory"] = facts.directory
    if moves:
        keys["migration"] = _RELAUNCH
    return Entry(keys, variables.left, "" if takes_directory else facts.directory)


def has_relaunch(plugins: Sequence[PluginRow]) -> bool:
    """Return True if processes of the cluster may move by the strategy `relaunch`."""
    return any(
        (row.kind, row.name, row.state) == ("migration", _RELAUNCH, "selected") for row in plugins
    )


def _program(facts: ProcessFacts) -> tuple[dict[str, Any], Sequence[str]]:
    """Return the keys that name the program, and the words after it."""
    first, *words = facts.words or (facts.program,)
    path = _absolute(first, facts)
    if facts.words[-1:] == ("",) and not _names_program(first, facts):
        words = []  # the process has set a title, which leaves NUL bytes in place of its arguments
    if not (_PYTHON.fullmatch(path.name) and words and not words[0].startswith("-")):
        return _package_of(path, facts) or {"command": [str(path)]}, words
    script = Path(facts.directory, words.pop(0))
    if script.name == "ros2" and _runs_package(words):
        return {"package": words[1], "executable": words[2]}, words[3:]
    return _package_of(script, facts) or {"command": [str(path), str(script)]}, words


def _runs_package(words: Sequence[str]) -> bool:
    """Return True for the words `run PACKAGE EXECUTABLE ...` after `ros2`."""
    return words[:1] == ["run"] and len(words[1:3]) == 2 and not words[1].startswith("-")


def _absolute(word: str, facts: ProcessFacts) -> Path:
    """Return the path of a program, without following links: a virtual environment is a link."""
    try:
        path = Path(facts.directory, on_path(word, facts.environment))
    except SpawnError:
        return Path(facts.program)
    return path if os.access(path, os.X_OK) else Path(facts.program)


def _names_program(word: str, facts: ProcessFacts) -> bool:
    try:
        path = Path(facts.directory, on_path(word, facts.environment))
    except SpawnError:
        return False
    return path.is_file() and os.access(path, os.X_OK)


def _package_of(path: Path, facts: ProcessFacts) -> dict[str, Any]:
    """Return package and executable of a file PREFIX/lib/PACKAGE/EXECUTABLE; {}: it is none."""
    package, executable = path.parent.name, path.name
    if path.parent.parent.name != "lib":
        return {}
    try:
        found = find_executable(package, executable, search_path(facts.environment, sys.executable))
        return {"package": package, "executable": executable} if found.samefile(path) else {}
    except (LaunchError, OSError):
        return {}
