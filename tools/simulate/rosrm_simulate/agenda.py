"""Agenda on virtual time: actions in order of time; at equal times in order of planning."""

from __future__ import annotations

import heapq
from collections.abc import Callable
from dataclasses import dataclass, field
from math import inf

Action = Callable[[], object]


@dataclass(order=True, slots=True)
class Entry:
    """One planned action.

    Attributes:
        action: None: it was cancelled.
    """

    time: float
    number: int
    action: Action | None = field(compare=False)


class Agenda:
    """The planned actions.

    Attributes:
        now: virtual seconds; never goes back.
        pending: number of actions to come.
    """

    def __init__(self) -> None:
        self.now = 0.0
        self.pending = 0
        self._entries: list[Entry] = []
        self._number = 0

    def at(self, time: float, action: Action) -> Entry:
        """Plan an action, not before now."""
        self._number += 1
        entry = Entry(max(time, self.now), self._number, action)
        heapq.heappush(self._entries, entry)
        self.pending += 1
        return entry

    def after(self, seconds: float, action: Action) -> Entry:
        """Plan an action in so many seconds."""
        return self.at(self.now + seconds, action)

    def call_off(self, entry: Entry | None) -> None:
        """Cancel an action, unless it was done; None is ignored."""
        if entry is not None and entry.action is not None:
            entry.action = None
            self.pending -= 1

    @property
    def next_time(self) -> float:
        """Return the time of the next action; inf: there is none."""
        while self._entries and self._entries[0].action is None:
            heapq.heappop(self._entries)
        return self._entries[0].time if self._entries else inf

    def do_next(self) -> None:
        """Advance the time to the next action, and do it."""
        entry = heapq.heappop(self._entries)
        action, entry.action = entry.action, None
        if action is not None:
            self.pending -= 1
            self.now = entry.time
            action()
