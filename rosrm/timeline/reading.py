"""Timeline of a cluster, read from its events one after the other."""

from __future__ import annotations

from typing import Final

from rosrm.model.event_kinds import EventKind
from rosrm.model.rows import EventRow
from rosrm.timeline.clock import EventClock
from rosrm.timeline.hosts import HostTimes
from rosrm.timeline.processes import ProcessReader, whole
from rosrm.timeline.values import Failure
from rosrm.wording import sanitized

FAILS: Final = frozenset({EventKind.FAILED, EventKind.BACKOFF})


class Timeline:
    """Processes and hosts over time; events come in order.

    Attributes:
        clock: seconds of the events.
        processes: placements, moves, waits and starts.
        hosts: times in which hosts were gone or over a limit.
        failures: of instances, the oldest first.
    """

    def __init__(self) -> None:
        self.clock = EventClock()
        self.processes = ProcessReader()
        self.hosts = HostTimes()
        self.failures: list[Failure] = []
        self._numbers: dict[str, int] = {}

    def take(self, event: EventRow) -> float:
        """Read the next event, and return its seconds."""
        time = self.clock.take(event)
        self.hosts.take(time, event)
        if event.process:
            self.processes.take(time, event)
            self._note_failure(time, event)
        return time

    def _note_failure(self, time: float, event: EventRow) -> None:
        if "number" in event.facts:
            self._numbers[event.process] = whole(event, "number")
        elif event.kind == EventKind.MIGRATION_BEGUN:
            self._numbers[event.process] = whole(event, "destination")
        if event.kind in FAILS:
            number = self._numbers.get(event.process, 0)
            restarts = event.kind == EventKind.BACKOFF
            message = sanitized(event.message, lines=True)
            self.failures.append(
                Failure(time, event.process, event.host, number, message, restarts)
            )
