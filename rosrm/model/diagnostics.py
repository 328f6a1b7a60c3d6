"""Diagnostic statuses of the cluster, with the levels of `diagnostic_msgs`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import IntEnum
from typing import Literal

from rosrm.model.values import EMPTY

#: Kind and name of what has a status: ("host", "robot-1"), ("process", "slam"), ("master", "lab").
Subject = tuple[Literal["master", "host", "process"], str]


class Level(IntEnum):
    """Level of a status, as `diagnostic_msgs` numbers them."""

    OK = 0
    WARN = 1
    ERROR = 2
    STALE = 3


@dataclass(frozen=True, slots=True)
class Diagnostic:
    """Status of the master, a host or a process.

    Attributes:
        host: the host that it concerns; "": none.
        values: further facts, by name.
    """

    subject: Subject
    level: Level
    message: str
    host: str = ""
    values: Mapping[str, str] = field(default_factory=lambda: EMPTY)
