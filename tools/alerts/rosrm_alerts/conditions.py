"""Alerts and their conditions."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TypeAlias

from rosrm.model.notices import NoticeLevel
from rosrm.model.values import EMPTY

#: Pattern that each name matches.
ANY = "*"


@dataclass(frozen=True, slots=True)
class Happens:
    """Events of some kinds happen, `count` times within `within` seconds.

    An alert on a single event begins with each event and never ends. With a higher count it ends
    when fewer events lie within the time.

    Attributes:
        kinds: kinds of the events.
        process: pattern of the process's name.
        host: pattern of the host's name.
        application: pattern of the process's application.
    """

    kinds: frozenset[str]
    process: str = ANY
    host: str = ANY
    application: str = ANY
    count: int = 1
    within: float = 0.0


@dataclass(frozen=True, slots=True)
class HostLost:
    """A host is lost: it was silent for its whole lease."""

    host: str = ANY


@dataclass(frozen=True, slots=True)
class Above:
    """A host uses more of a resource than a limit.

    Attributes:
        limit: share of the capacity; None: the limit of the host.
    """

    resource: str
    limit: float | None = None
    host: str = ANY


@dataclass(frozen=True, slots=True)
class InState:
    """A process is in one of some states."""

    states: frozenset[str]
    process: str = ANY
    application: str = ANY


@dataclass(frozen=True, slots=True)
class NoAnswer:
    """The master does not answer."""


Condition: TypeAlias = "Happens | HostLost | Above | InState | NoAnswer"


@dataclass(frozen=True, slots=True)
class Alert:
    """A condition that must be reported.

    Attributes:
        lasts: seconds for which the condition must hold before the alert begins.
        to: names of the sinks that get its notices.
    """

    name: str
    condition: Condition
    lasts: float = 0.0
    level: NoticeLevel = "WARN"
    to: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class SeenResource:
    """A fresh reading of a host: usage and limit as shares of the capacity."""

    usage: float
    limit: float = 1.0


@dataclass(frozen=True, slots=True)
class SeenHost:
    """A host of a listing; `resources` without stale readings."""

    state: str = "up"
    resources: Mapping[str, SeenResource] = field(default_factory=lambda: EMPTY)


@dataclass(frozen=True, slots=True)
class SeenProcess:
    """A process of a listing."""

    state: str
    application: str = ""
    reason: str = ""


@dataclass(frozen=True, slots=True)
class Situation:
    """The cluster at one time, by the names of hosts and processes."""

    hosts: Mapping[str, SeenHost] = field(default_factory=lambda: EMPTY)
    processes: Mapping[str, SeenProcess] = field(default_factory=lambda: EMPTY)


@dataclass(frozen=True, slots=True)
class SeenEvent:
    """An event of the journal."""

    kind: str
    process: str = ""
    host: str = ""
    message: str = ""
