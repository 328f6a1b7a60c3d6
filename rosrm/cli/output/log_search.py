"""Choice and form of single lines of a log: search, level, time, colour, JSON."""

from __future__ import annotations

import json
import re
import warnings
from dataclasses import dataclass
from typing import Final

from rosrm.cli.output.log_levels import Level, level_of, stamp_of
from rosrm.errors import ConfigError

#: Longest difference (s) between the time in a line and the check that found the line.
_NEAR: Final = 10.0
_COLOURS: Final = {Level.DEBUG: "2", Level.WARN: "33", Level.ERROR: "31", Level.FATAL: "1;31"}


@dataclass(frozen=True)
class LineSearch:
    """Condition on the lines that are shown, and their form.

    Attributes:
        pattern: that a line must contain; None: any.
        level: lowest level of a line; None: any, also lines without a level.
        until: unix time (s) of the newest line; 0.0: no bound.
        as_json: an object for each line.
        coloured: colour the lines by their levels.
    """

    pattern: re.Pattern[str] | None = None
    level: Level | None = None
    until: float = 0.0
    as_json: bool = False
    coloured: bool = False

    @property
    def is_selective(self) -> bool:
        """Return True if lines of rosrm are left out, because only found lines are wanted."""
        return self.pattern is not None or self.level is not None or self.as_json


def pattern_of(option: str, text: str) -> re.Pattern[str]:
    """Return the regular expression of an option; raises `ConfigError`."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of a set that a later Python may read differently
            return re.compile(text)
    except (re.error, RecursionError, OverflowError) as error:
        raise ConfigError(
            f"{option} {text}: this is no regular expression: {error}. A backslash before a "
            r"special character searches for the character itself, e.g. \[nav\]"
        ) from None


class LineContext:
    """Time and level of the lines of one program, where not every line has its own.

    A line without a level, such as one of a traceback, has that of the line before. The time of a
    line is that of the check in which the supervisor found it. A ROS node writes a more exact time
    into its lines; lines without a time that were found in the same check have that time too.
    """

    def __init__(self) -> None:
        self.level: Level | None = None
        self.time = 0.0
        self._found_at = -1.0

    def begin_program(self) -> None:
        """Forget the level: another program begins."""
        self.level = None

    def add(self, line: str, found_at: float) -> None:
        """Set level and time of the next line, which the supervisor found at a unix time."""
        self.level = level_of(line) or self.level
        stamp = stamp_of(line)
        if 0.0 <= found_at - stamp <= _NEAR:
            self.time = stamp
        elif found_at != self._found_at:
            self.time = found_at
        self._found_at = found_at


def is_shown(line: str, context: LineContext, search: LineSearch) -> bool:
    """Return True if a search finds a line, to which the context belongs."""
    if search.level is not None and (context.level is None or context.level < search.level):
        return False
    if search.until and context.time > search.until:
        return False
    return search.pattern is None or search.pattern.search(line.rstrip("\r\n")) is not None


def coloured(line: str, level: Level) -> str:
    """Return a line in the colour of its level."""
    colour = _COLOURS.get(level)
    if colour is None:
        return line
    text = line.rstrip("\n")
    return f"\x1b[{colour}m{text}\x1b[0m{line[len(text) :]}"


def json_line(line: str, context: LineContext, process: str, host: str, number: int) -> str:
    """Return a line as a JSON object."""
    return json.dumps({
        "time": round(context.time, 6), "process": process, "host": host, "instance": number,
        "level": context.level.name if context.level is not None else "",
        "line": line.rstrip("\r\n"),
    }) + "\n"  # fmt: skip
