"""Following of the event record, also across a journal that has lost its newest records.

After such a loss new events have sequences that a follower has seen. So each request asks for the
last known event once more, which shows whether the record is still the same.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Final

from rosrm.model.rows import EventRow, Listing
from rosrm.model.values import EMPTY

#: Number of known events that are remembered; a journal gap is shorter.
_KNOWN: Final = 1000
#: Number of events in one listing that leaves out none, as in `List.srv`.
_ALL: Final = 2**32 - 1


class EventFeed:
    """The events of one selection that a follower has not seen.

    Args:
        ask: returns the newest selected events after a sequence, given that and their number.
        after: sequence of the last event that the follower has seen.
        newest: most events of the first request; 0: the default of the master.
        last: the event `after`, as attribute `last` of an earlier feed; None: not known. Without
            it a record that lost this event before the first request looks the same.

    Attributes:
        after: sequence of the last event that `new` has yielded.
    """

    def __init__(
        self, ask: Callable[[int, int], Listing], after: int, newest: int,
        last: EventRow | None = None,
    ) -> None:  # fmt: skip
        self._ask = ask
        self.after = after
        self._newest = newest
        self._known: dict[int, EventRow] = {} if last is None else {after: last}  # no facts

    @property
    def last(self) -> EventRow | None:
        """Return the event `after`, without its facts; None: not known."""
        return self._known.get(self.after)

    def new(self) -> Iterator[EventRow]:
        """Yield the events since the last request."""
        listing = self._ask(max(self.after - 1, 0), self._newest)
        self._newest = _ALL
        events, last = listing.events, self.last
        first = [_bare(one) for one in events[:1]]
        if listing.last_sequence < self.after or (last is not None and last not in first):
            is_new, events = self._is_new_in_other_record, self._ask(0, _ALL).events
            self.after = listing.last_sequence
        else:
            is_new = self._is_new
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

    def _is_new_in_other_record(self, event: EventRow) -> bool:
        """Return True unless an event was there before the record lost its newest ones."""
        if not self._known:
            return True
        if event.sequence >= min(self._known):
            return self._known.get(event.sequence) != _bare(event)
        return event.wall_time > max(one.wall_time for one in self._known.values())


def _bare(event: EventRow) -> EventRow:
    return replace(event, facts=EMPTY)
