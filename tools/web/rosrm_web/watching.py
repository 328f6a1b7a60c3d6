"""State of the master, and the newest events, by regular requests."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, Literal

from rosrm.errors import NoMaster, RosrmError, describe_fault
from rosrm_web.master_link import Busy

if TYPE_CHECKING:
    from rosrm.client.client import Client
    from rosrm.model.rows import EventRow, Listing
    from rosrm_web.master_link import MasterLink

#: Seconds between two requests to the master.
PERIOD: Final = 0.1
#: Most seconds between the times of two copies of one event, which have the same sequence.
_SAME: Final = 0.001
#: Most new events of one request; if there are more, the oldest are left out.
MOST_EVENTS: Final = 1000
#: Seconds without an answer after which the master counts as lost.
SILENCE: Final = 2.0

State = Literal["searching", "up", "lost"]

_log = logging.getLogger("rosrm.web")


@dataclass(frozen=True)
class MasterState:
    """Condition of the master as the gateway sees it.

    Attributes:
        state: "searching": the master has not answered yet; "up"; "lost": it does not answer.
        reason: why there is no master; "": there is one.
    """

    state: State = "searching"
    reason: str = "the gateway is searching for a master"


def give_up_early(seconds: float) -> None:
    """End a listing to which the master is silent; the argument is the seconds of the wait."""
    if seconds >= SILENCE:
        raise NoMaster(
            f"the master has not answered for {SILENCE:g} s; the gateway asks again until it "
            "answers. Is `rosrm master` running?"
        )


class Watcher:
    """Requests new events regularly; each answer shows that the master is up.

    Attributes:
        master: newest known state of the master.
        load: figures of the master, as `Client.master_load` returns them.
        on_master: called with each new state of the master.
        on_events: called with new events, the oldest first.
        on_new_journal: called when the sequences of events have begun again, before new events.
    """

    def __init__(self, link: MasterLink) -> None:
        self._link = link
        self._after = -1
        self._written = 0.0  # unix time of the event with this sequence; 0: unknown
        self.master = MasterState()
        self.load: Mapping[str, float] = {}
        self.on_master: list[Callable[[MasterState], None]] = []
        self.on_events: list[Callable[[Sequence[EventRow]], None]] = []
        self.on_new_journal: list[Callable[[], None]] = []

    async def run(self) -> None:
        """Ask until the task is cancelled."""
        while True:
            with suppress(RosrmError):  # the state of the master has it
                await self.look()
            await asyncio.sleep(PERIOD)

    async def look(self) -> None:
        """Ask once; raises `RosrmError`."""
        try:
            listing = await self._link.ask(self._list)
        except Busy:  # nothing was sent, so the state of the master is as before
            raise
        except Exception as error:
            state: State = "lost" if self._after >= 0 else "searching"
            why = str(error) if isinstance(error, RosrmError) else describe_fault(error)
            self._set_master(MasterState(state, why))
            raise
        self._set_master(MasterState("up", ""))
        events = listing.events
        has_last = bool(events) and events[0].sequence == self._after
        if listing.last_sequence < self._after or (has_last and self._is_other(events[0])):
            self._after = 0  # the next request has the first events of the new journal
            _call_all(self.on_new_journal)
            return
        self._after = listing.last_sequence
        self._written = events[-1].wall_time if events else 0.0
        news = events[has_last:]
        if news:
            _call_all(self.on_events, news)

    def _is_other(self, event: EventRow) -> bool:
        """Return True if an event is not the last known one, so that the journal is new."""
        return self._written > 0.0 and abs(event.wall_time - self._written) > _SAME

    def _list(self, client: Client) -> Listing:
        self.load = client.master_load()
        if self._after < 0:  # the events before the first request are no changes
            return client.list(on_wait=give_up_early)
        after = max(self._after - 1, 0)  # with the last known event, which identifies the journal
        return client.list(events=True, after=after, newest=MOST_EVENTS, on_wait=give_up_early)

    def _set_master(self, master: MasterState) -> None:
        is_new = master.state != self.master.state
        self.master = master
        if is_new:
            _log.info("master is %s%s", master.state, f": {master.reason}" if master.reason else "")
            _call_all(self.on_master, master)


def _call_all(readers: Sequence[Callable[..., None]], *news: object) -> None:
    """Call each reader; one that raises must not stop the others, or the watcher."""
    for call in readers:
        try:
            call(*news)
        except Exception:  # noqa: BLE001 - see above
            _log.exception("a part of the gateway cannot read what is new")
