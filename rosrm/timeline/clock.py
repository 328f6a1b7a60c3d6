"""Seconds of events since the first one, over restarts of the master."""

from __future__ import annotations

from rosrm.model.event_kinds import EventKind
from rosrm.model.rows import EventRow


class EventClock:
    """Converts the times of events, which come in order.

    Within a run of a master its monotonic clock counts, and unix time between two runs.

    Attributes:
        newest: seconds of the newest event.
    """

    def __init__(self) -> None:
        self.newest = 0.0
        self._offset = 0.0
        self._before: EventRow | None = None

    def take(self, event: EventRow) -> float:
        """Return the seconds of the next event."""
        before = self._before
        if before is None:
            self._offset = -event.elapsed
        elif event.kind == EventKind.MASTER_STARTED or event.elapsed < before.elapsed:
            pause = max(0.0, event.wall_time - before.wall_time)
            self._offset = self.newest + pause - event.elapsed
        self._before = event
        self.newest = event.elapsed + self._offset
        return self.newest

    def at(self, elapsed: float) -> float:
        """Return the seconds of a time since the start of the present master."""
        return elapsed + self._offset

    def wall_time(self, seconds: float) -> float:
        """Return seconds as unix time, by the clock of the newest event; 0: there is no event."""
        before = self._before
        return 0.0 if before is None else before.wall_time + seconds - self.newest

    def seconds(self, wall_time: float) -> float:
        """Return unix time as seconds, the inverse of `wall_time`; 0: there is no event."""
        before = self._before
        return 0.0 if before is None else self.newest + wall_time - before.wall_time
