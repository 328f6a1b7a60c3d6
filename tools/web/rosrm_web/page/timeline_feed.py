"""Timeline of the events that the gateway knows, for all browsers."""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
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
#: Most events that the master sends at once, which a user may ask for.
MOST_READ: Final = 10_000
#: Events that are kept while the gateway runs.
MOST_KEPT: Final = 10_000


class Feed:
    """The newest events as a timeline; no event is read before a page shows the timeline.

    Attributes:
        timeline: of the kept events.
        newest: sequence of the newest event; 0: none was read yet.
        has_older: the master may send older events than those of the timeline.
    """

    def __init__(self, gateway: Gateway) -> None:
        self._gateway = gateway
        self._events: deque[EventRow] = deque(maxlen=MOST_KEPT)
        self._taken = 0
        self._is_whole = False
        self._reading = asyncio.Lock()
        self.timeline = Timeline()
        self.newest = 0
        self.has_older = False
        self._number = FIRST
        gateway.watcher.on_events.append(self.take)
        gateway.watcher.on_new_journal.append(self._forget)

    async def read(self) -> None:
        """Read the newest events of the master, unless they are known."""
        async with self._reading:
            if self._is_whole:
                return
            with suppress(RosrmError):  # the header says that the master is lost
                request = partial(_newest, number=self._number)
                rows = await self._gateway.ask(self._gateway.reading, request)
                self._is_whole = True
                self.has_older = self._number < MOST_READ and len(rows) >= self._number
                self._events.clear()
                self._events.extend(map(_without_decision, rows))
                self._begin_again()

    async def read_older(self) -> None:
        """Read as many events as the master sends."""
        self._number, self._is_whole = MOST_READ, False
        await self.read()

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
        self._is_whole, self.newest, self._number = False, 0, FIRST
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


def _newest(client: Client, number: int) -> Sequence[EventRow]:
    return client.list(events=True, newest=number, on_wait=give_up_early).events


def _without_decision(row: EventRow) -> EventRow:
    """Return an event without its largest fact, which no timeline shows."""
    if "decision" not in row.facts:
        return row
    return replace(row, facts={k: v for k, v in row.facts.items() if k != "decision"})
