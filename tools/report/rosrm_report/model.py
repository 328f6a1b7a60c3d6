"""Values of a report. All times are seconds since its beginning."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from rosrm.model.notices import NoticeLevel
from rosrm.model.rows import EventRow
from rosrm.model.values import EMPTY
from rosrm.timeline.values import Failure, HostSpan, Move, Outcome, Placement, Start, Wait


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
class CloseDecision:
    """An assignment with two hosts of nearly the same score. Lower scores are better."""

    time: float
    process: str
    host: str
    score: float
    second: str
    second_score: float


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
