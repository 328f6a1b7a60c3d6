"""Timeline of the events that the gateway knows, for all browsers."""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from typing import TYPE_CHECKING, Final

from rosrm.errors import RosrmError
from rosrm.timeline.reading import Timeline
from rosrm_web.watching import MOST_EVENTS, give_up_early

if TYPE_CHECKING:
    from rosrm.client.client import Client
    from rosrm.model.rows import EventRow
    from rosrm_web.gateway import Gateway

#: Events that the first timeline begins with; the master reads them between its other tasks.
FIRST: Final = 5000
#: Events that are kept while the gateway runs.
MOST_KEPT: Final = 10_000


class Feed:
    """The newest events as a timeline; no event is read before a page shows the timeline.

    Attributes:
        timeline: of the kept events.
        newest: sequence of the newest event; 0: none was read yet.
    """

    def __init__(self, gateway: Gateway) -> None:
        self._gateway = gateway
        self._events: deque[EventRow] = deque(maxlen=MOST_KEPT)
        self._taken = 0
        self._is_whole = False
        self._reading = asyncio.Lock()
        self.timeline = Timeline()
        self.newest = 0
        gateway.watcher.on_events.append(self.take)
        gateway.watcher.on_new_journal.append(self._forget)

    async def read(self) -> None:
        """Read the newest events of the master, unless they are known."""
        async with self._reading:
            if self._is_whole:
                return
            with suppress(RosrmError):  # the header says that the master is lost
                rows = await self._gateway.ask(self._gateway.reading, _newest)
                self._is_whole = True
                self._events.clear()
                self._events.extend(map(_without_decision, rows))
                self._begin_again()

    def take(self, rows: Sequence[EventRow]) -> None:
        """Add new events; events of a burst may be missing, and then all are read again."""
        if len(rows) >= MOST_EVENTS:
            self._is_whole = False
        if not self._is_whole:
            return
        for row in rows:
            if row.sequence > self.newest:
                self._events.append(_without_decision(row))
                self._add(self._events[-1])
        if self._taken >= 2 * MOST_KEPT:
            self._begin_again()

    def _forget(self) -> None:
        """Drop all events; the next `read` has those of the new journal."""
        self._is_whole, self.newest = False, 0
        self._events.clear()
        self._begin_again()

    def _begin_again(self) -> None:
        """Read the kept events into a new timeline, which does not have the older ones."""
        self.timeline, self._taken = Timeline(), 0
        for row in self._events:
            self._add(row)

    def _add(self, row: EventRow) -> None:
        self.timeline.take(row)
        self.newest, self._taken = row.sequence, self._taken + 1


def _newest(client: Client) -> Sequence[EventRow]:
    return client.list(events=True, newest=FIRST, on_wait=give_up_early).events


def _without_decision(row: EventRow) -> EventRow:
    """Return an event without its largest fact, which no timeline shows."""
    if "decision" not in row.facts:
        return row
    return replace(row, facts={k: v for k, v in row.facts.items() if k != "decision"})
