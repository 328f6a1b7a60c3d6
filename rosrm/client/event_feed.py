"""Following of the event record, also across a journal that has lost its newest records.

After such a loss new events have sequences that a follower has seen. So each request asks for the
last known event once more, which shows whether the record is still the same.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator
from dataclasses import replace
from functools import partial
from math import inf
from typing import Final

from rosrm.model.event_kinds import EventKind
from rosrm.model.rows import EventRow, Listing
from rosrm.model.values import EMPTY

#: Number of known events that are remembered; a journal gap is shorter.
_KNOWN: Final = 1000
#: Number of events in one listing that leaves out none, as in `List.srv`.
ALL: Final = 2**32 - 1


class EventFeed:
    """The events of the cluster that a follower has not seen.

    Args:
        ask: returns the newest events after a sequence, given that and their number. A selection
            of them may lack the last known event, so a journal gap may go unnoticed.
        after: sequence of the last event that the follower has seen.
        newest: most events of the first request; 0: the default of the master.
        known: events that the follower has seen, as `known` or `last` of an earlier feed. Without
            the event `after`, a record that lost it before the first request looks the same.

    Attributes:
        after: sequence of the last event that `new` has yielded.
        listing: the newest answer of the master.
    """

    listing: Listing

    def __init__(
        self, ask: Callable[[int, int], Listing], after: int, newest: int,
        known: Iterable[EventRow] = (),
    ) -> None:  # fmt: skip
        self._ask = ask
        self.after = after
        self._newest = newest
        self._known = {one.sequence: one for one in known}  # without facts

    @property
    def known(self) -> Collection[EventRow]:
        """Return the newest events that the follower has seen, without their facts."""
        return self._known.values()

    @property
    def last(self) -> EventRow | None:
        """Return the event `after`, without its facts; None: not known."""
        return self._known.get(self.after)

    def new(self) -> Iterator[EventRow]:
        """Yield the events since the last request."""
        self.listing = listing = self._ask(max(self.after - 1, 0), self._newest)
        self._newest = ALL
        events, last = listing.events, self.last
        first = [_bare(one) for one in events[:1]]
        is_new: Callable[[EventRow], bool] = self._is_new
        if listing.last_sequence < self.after or (last is not None and last not in first):
            events = self._ask(0, ALL).events
            starts = (one.sequence for one in events if one.kind == EventKind.MASTER_STARTED)
            is_new = partial(self._is_new_in_other_record, max(starts, default=inf))
            self.after = listing.last_sequence
        for event in events:
            if is_new(event):
                yield event
            elif event.sequence != self.after:
                continue
            self._known[event.sequence] = _bare(event)
            self.after = event.sequence
        while len(self._known) > _KNOWN:
            del self._known[min(self._known)]

    def _is_new(self, event: EventRow) -> bool:
        return event.sequence > self.after

    def _is_new_in_other_record(self, run: float, event: EventRow) -> bool:
        """Return True unless an event was there before the record lost its newest ones.

        `run`: sequence of the first event of the master's run, which has begun since then.
        """
        if not self._known:
            return True
        if event.sequence >= min(self._known):
            return self._known.get(event.sequence) != _bare(event)
        # The clock of a machine that has lost its power may be behind.
        known = max(one.wall_time for one in self._known.values())
        return event.sequence >= run or event.wall_time > known


def _bare(event: EventRow) -> EventRow:
    return replace(event, facts=EMPTY)
