"""Level and time in a line of output: lines of ROS nodes and of Python's `logging`.

=============================================  ======================
line                                           comes from
=============================================  ======================
`[WARN] [1732700000.123] [nav]: battery low`   rclcpp, rclpy (default)
`[nav-3] [1732700000.1] [WARN] [nav]: …`       other formats in brackets
`WARNING:nav:battery low`                      `logging` (default)
`2026-11-27 09:30:00,123 WARNING nav: …`       `logging` with a time
=============================================  ======================
"""

from __future__ import annotations

import re
from enum import IntEnum
from typing import Final

from rosrm.errors import ConfigError


class Level(IntEnum):
    """Level of a line, with the numbers of ROS."""

    DEBUG = 10
    INFO = 20
    WARN = 30
    ERROR = 40
    FATAL = 50


_ALIASES: Final = {"WARNING": "WARN", "CRITICAL": "FATAL"}
_WORDS: Final = "DEBUG|INFO|WARN|WARNING|ERROR|FATAL|CRITICAL"
#: Colours, which ROS nodes print before and after the line.
_COLOUR: Final = re.compile(r"\x1b\[[\d;]{0,16}m")
_DATE: Final = r"\d{4}-\d\d-\d\d[T ]\d\d:\d\d:\d\d\S{0,12} (?:- \S{1,80} - )?\[?"
_LEVEL: Final = re.compile(
    rf"(?:\[[^\[\]]{{0,80}}\] ){{0,3}}\[({_WORDS})\]|({_WORDS}):|{_DATE}({_WORDS})\b"
)
_STAMP: Final = re.compile(r"(?:\[[^\[\]]{0,80}\] ){0,3}\[(\d{9,10}\.\d{1,9})\]")
#: Characters at the beginning of a line in which level and time are looked for.
_HEAD: Final = 400


def level_of(line: str) -> Level | None:
    """Return the level of a line; None: the line has none that is recognised."""
    found = _LEVEL.match(_head(line))
    return _level(found[found.lastindex or 0]) if found else None


def stamp_of(line: str) -> float:
    """Return the time in a line of a ROS node (unix time, s); 0.0: the line has none."""
    found = _STAMP.match(_head(line))
    return float(found[1]) if found else 0.0


def level_named(option: str, name: str) -> Level:
    """Return the level that an option names; raises `ConfigError`."""
    try:
        return _level(name.upper())
    except KeyError:
        raise ConfigError(
            f"{option} {name}: a level is debug, info, warn, error or fatal"
        ) from None


def _level(word: str) -> Level:
    return Level[_ALIASES.get(word, word)]


def _head(line: str) -> str:
    return _COLOUR.sub("", line[:_HEAD])
