"""Values of a report. All times are seconds since its beginning."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

from rosrm.model.notices import NoticeLevel
from rosrm.model.rows import EventRow
from rosrm.model.values import EMPTY


@dataclass(frozen=True, slots=True)
class Readings:
    """Usage of hosts over time.

    Attributes:
        times: T seconds, ascending; a value holds until the next time.
        usage: resource to host to T fractions; None: not known.
        limits: resource to host to the newest limit, fraction.
    """

    times: tuple[float, ...]
    usage: Mapping[str, Mapping[str, tuple[float | None, ...]]]
    limits: Mapping[str, Mapping[str, float]]


@dataclass(frozen=True, slots=True)
class Material:
    """Content of a source.

    Attributes:
        name: the source, as a user names it.
        events: in order of their sequence.
        readings: in seconds since the first event; None: the source has none.
        notes: sentences on what the source lacks.
    """

    name: str
    events: Sequence[EventRow]
    readings: Readings | None = None
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Placement:
    """Time of a process on one host.

    Attributes:
        number: of the instance; 0: not known.
        ended_by: kind of the event that ended it; "": it had not ended at the end of the report.
    """

    process: str
    host: str
    begin: float
    end: float
    number: int = 0
    ended_by: str = ""


@dataclass(frozen=True, slots=True)
class Move:
    """A process that changed its host, or a migration that failed.

    A migration within a host, e.g. to the instance of a new version, counts as a replacement.

    Attributes:
        time: of its end.
        how: strategy of the migration; "restart": the process was started again elsewhere.
        seconds: duration of the migration; None: no migration.
        done: False: the process stayed.
    """

    time: float
    process: str
    source: str
    destination: str
    how: str
    cause: str
    seconds: float | None = None
    done: bool = True

    @property
    def within(self) -> bool:
        """Return True if both instances were on the same host."""
        return self.source == self.destination


@dataclass(frozen=True, slots=True)
class Wait:
    """Time of a process in the queue or set aside.

    Attributes:
        reason: the newest known reason; "": it did not have to wait for a host.
        over: False: it still waited at the end of the report.
    """

    process: str
    begin: float
    end: float
    reason: str = ""
    over: bool = True

    @property
    def seconds(self) -> float:
        """Return its duration."""
        return self.end - self.begin


@dataclass(frozen=True, slots=True)
class Start:
    """A start of a process on a host, from its assignment until it was running or ready."""

    process: str
    host: str
    time: float
    seconds: float


@dataclass(frozen=True, slots=True)
class CloseDecision:
    """An assignment with two hosts of nearly the same score. Lower scores are better."""

    time: float
    process: str
    host: str
    score: float
    second: str
    second_score: float


@dataclass(frozen=True, slots=True)
class Failure:
    """An instance that ended with a failure.

    Attributes:
        restarts: the process was started again.
        lines: last lines of its log; empty: not known.
    """

    time: float
    process: str
    host: str
    number: int
    message: str
    restarts: bool
    lines: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Fault:
    """Any other event with a level above "INFO", or a restart of the master."""

    time: float
    level: NoticeLevel
    kind: str
    host: str
    process: str
    message: str


@dataclass(frozen=True, slots=True)
class HostSpan:
    """Time in which a host was gone, or over its limit of a resource.

    Attributes:
        what: "lost", "left", "detached", or the resource.
    """

    host: str
    what: str
    begin: float
    end: float


@dataclass(frozen=True, slots=True)
class HostFigures:
    """One host in numbers.

    Attributes:
        over_limit: seconds over any of its limits, by resource summed.
        peaks: resource to the highest known usage, fraction.
    """

    host: str
    assignments: int
    moves_from: int
    moves_to: int
    failures: int
    over_limit: float
    peaks: Mapping[str, float] = field(default_factory=lambda: EMPTY)


#: State of a process at the end of the report.
Outcome = Literal["finished", "failed", "cancelled", "running", "waiting"]


@dataclass(frozen=True, slots=True)
class Report:
    """A whole run.

    Attributes:
        began: unix time of the beginning.
        length: seconds.
        outcomes: process to its state at the end.
        queue: changes of the number of waiting processes, each with its time.
        events: number of events in the source.
    """

    title: str
    source: str
    began: float
    length: float
    notes: tuple[str, ...]
    outcomes: Mapping[str, Outcome]
    hosts: tuple[HostFigures, ...]
    placements: tuple[Placement, ...]
    moves: tuple[Move, ...]
    waits: tuple[Wait, ...]
    starts: tuple[Start, ...]
    close_decisions: tuple[CloseDecision, ...]
    failures: tuple[Failure, ...]
    faults: tuple[Fault, ...]
    gone: tuple[HostSpan, ...]
    over_limit: tuple[HostSpan, ...]
    queue: tuple[tuple[float, int], ...]
    readings: Readings | None = None
    events: int = 0
