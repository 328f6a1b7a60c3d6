"""Histories of processes: placements, waits, starts and moves from the events."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Final

from rosrm.model.event_kinds import EventKind
from rosrm.model.rows import EventRow
from rosrm.timeline.values import Move, Outcome, Placement, Start, Wait

#: Kinds of events that end the placement of a process.
_LEAVES: Final = frozenset(
    {
        EventKind.QUEUED, EventKind.SET_ASIDE, EventKind.GIVEN_UP, EventKind.FINISHED,
        EventKind.FAILED, EventKind.CANCELLED, EventKind.CHECKPOINTED,
    }
)  # fmt: skip
#: Those after which it is started again elsewhere, for the reason in the event.
_REQUEUES: Final = frozenset({EventKind.QUEUED, EventKind.SET_ASIDE, EventKind.GIVEN_UP})
_ENDS: Final[dict[str, Outcome]] = {
    EventKind.FINISHED: "finished", EventKind.FAILED: "failed",
    EventKind.CANCELLED: "cancelled", EventKind.CHECKPOINTED: "cancelled",
}  # fmt: skip
_WAITS: Final = frozenset({EventKind.SUBMITTED, EventKind.QUEUED, EventKind.SET_ASIDE})
#: Kinds of events of a process that is on the host of the event.
_RUNS: Final = frozenset(
    {
        EventKind.ASSIGNED, EventKind.STARTING, EventKind.RUNNING, EventKind.READY,
        EventKind.REACHABLE, EventKind.BACKOFF, EventKind.READOPTED, EventKind.RESTORED,
        EventKind.MIGRATED,
    }
)  # fmt: skip
#: Kinds of events with which another instance begins, also on the same host.
_BEGINS: Final = frozenset({EventKind.ASSIGNED, EventKind.MIGRATED})
_STARTED: Final = frozenset({EventKind.RUNNING, EventKind.READY})
_MIGRATES: Final = frozenset({EventKind.MIGRATION_BEGUN, EventKind.FAILED_OVER})


@dataclass(slots=True)
class Histories:
    """Histories of all processes of a run."""

    placements: list[Placement] = field(default_factory=list)
    waits: list[Wait] = field(default_factory=list)
    starts: list[Start] = field(default_factory=list)
    moves: list[Move] = field(default_factory=list)
    outcomes: dict[str, Outcome] = field(default_factory=dict)
    queue: list[tuple[float, int]] = field(default_factory=list)


@dataclass(slots=True)
class _Process:
    """Current placement, wait and start of one process."""

    host: str = ""
    since: float = 0.0
    number: int = 0
    assigned: float | None = None
    waits_since: float | None = None
    reason: str = ""
    left: tuple[str, str] = ("", "")
    destination: int = 0


def whole(event: EventRow, fact: str) -> int:
    """Return a fact that is a number of an instance; 0: it is not known."""
    value = event.facts.get(fact)
    return value if isinstance(value, int) else 0


class ProcessReader:
    """Reads the events of processes in order."""

    def __init__(self) -> None:
        self._found = Histories()
        self._processes: dict[str, _Process] = {}
        self._waiting = 0

    def take(self, time: float, event: EventRow) -> None:
        """Read the next event of a process."""
        kind = event.kind
        one = self._processes.setdefault(event.process, _Process())
        if kind in _LEAVES:
            self._leave(one, time, event)
        if kind in _WAITS and one.waits_since is None:
            one.waits_since, one.reason = time, ""
            self._count(time, 1)
        elif kind == EventKind.WAITS or (kind == EventKind.SET_ASIDE and event.message):
            one.reason = event.message
        if kind in _MIGRATES:
            one.destination = whole(event, "destination")
        elif kind in (EventKind.MIGRATED, EventKind.STAYED):
            self._migrated(one, time, event)
        if kind in _RUNS:
            self._run(one, time, event)
        elif kind in _ENDS:
            self._stop_waiting(event.process, one, time)
            self._found.outcomes[event.process] = _ENDS[kind]

    def _run(self, one: _Process, time: float, event: EventRow) -> None:
        self._stop_waiting(event.process, one, time)
        self._found.outcomes[event.process] = "running"
        number = whole(event, "number")
        if event.kind == EventKind.MIGRATED:
            number = one.destination
        if event.kind == EventKind.ASSIGNED:
            self._note_return(one, time, event)
        elif event.kind in _STARTED and one.assigned is not None:
            seconds = time - one.assigned
            self._found.starts.append(Start(event.process, event.host, one.assigned, seconds))
            one.assigned = None
        if one.host != event.host or event.kind in _BEGINS:
            self._leave(one, time, event)
            one.host, one.since = event.host, time
            one.assigned = time if event.kind == EventKind.ASSIGNED else None
        one.number = number or one.number

    def _leave(self, one: _Process, time: float, event: EventRow) -> None:
        if one.host:
            place = Placement(event.process, one.host, one.since, time, one.number, event.kind)
            self._found.placements.append(place)
            one.left = (one.host, event.message) if event.kind in _REQUEUES else ("", "")
        one.host, one.assigned = "", None

    def _note_return(self, one: _Process, time: float, event: EventRow) -> None:
        """Note a start on another host than before as a move."""
        source, cause = one.left
        if source and source != event.host and not one.host:
            move = Move(time, event.process, source, event.host, "restart", cause)
            self._found.moves.append(move)
        one.left = ("", "")

    def _migrated(self, one: _Process, time: float, event: EventRow) -> None:
        facts = event.facts
        done = event.kind == EventKind.MIGRATED
        cause = str(facts.get("cause", "")) if done else event.message
        seconds = facts.get("seconds")
        seconds = float(seconds) if isinstance(seconds, float | int) else None
        move = Move(
            time, event.process, str(facts.get("from", one.host)), str(facts.get("to", "")),
            str(facts.get("strategy", "")), cause, seconds, done,
        )  # fmt: skip
        self._found.moves.append(move)

    def _stop_waiting(self, name: str, one: _Process, time: float) -> None:
        if one.waits_since is not None:
            self._found.waits.append(Wait(name, one.waits_since, time, one.reason))
            one.waits_since = None
            self._count(time, -1)

    def _count(self, time: float, change: int) -> None:
        self._waiting += change
        queue = self._found.queue
        if queue and queue[-1][0] == time:
            queue[-1] = (time, self._waiting)
        else:
            queue.append((time, self._waiting))

    def histories(self, end: float) -> Histories:
        """Return the histories up to now; what has not ended yet is in them up to `end`."""
        found = self._found
        placements, waits, outcomes = (
            list(found.placements),
            list(found.waits),
            dict(found.outcomes),
        )
        for name, one in self._processes.items():
            if one.host:
                placements.append(Placement(name, one.host, one.since, end, one.number))
            if one.waits_since is not None:
                outcomes[name] = "waiting"
                waits.append(Wait(name, one.waits_since, end, one.reason, over=False))
        placements.sort(key=lambda one: (one.begin, one.process))
        return replace(found, placements=placements, waits=waits, outcomes=outcomes)
