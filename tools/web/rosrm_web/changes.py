"""Changes of the cluster as server-sent events: new events, and the state of the master."""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncIterator, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from typing import TYPE_CHECKING, Annotated, Any, Final

from fastapi import Header, Query
from fastapi.responses import Response, StreamingResponse

from rosrm.cli.output import json_forms
from rosrm.errors import RosrmError
from rosrm.model.values import LARGEST_NUMBER
from rosrm_web.master_link import Busy
from rosrm_web.watching import MOST_EVENTS, give_up_early

if TYPE_CHECKING:
    from rosrm.client.client import Client
    from rosrm.model.rows import EventRow, Listing
    from rosrm_web.gateway import Gateway
    from rosrm_web.watching import MasterState

#: Highest number of readers at the same time.
MOST_READERS: Final = 32
#: Changes that a reader may leave behind, about 25 s of a busy cluster; then the stream ends.
MOST_BEHIND: Final = 128
#: Seconds without a change after which a comment shows that the stream still works.
HEARTBEAT: Final = 15.0
#: Encoded changes; with the sequence of each, 0: it is no event, `RESET`: sequences begin again.
Part = tuple[tuple[int, bytes], ...]
RESET: Final = -1

_COMMENT: Final[Part] = ((0, b":\n\n"),)
#: `id` of an event: its sequence, and the ms of its unix time, by which another journal shows.
_ID: Final = r"\d{1,19}(-\d{1,19})?"


class Reader:
    """A queue of the changes that one reader has not taken yet."""

    def __init__(self) -> None:
        self._parts: asyncio.Queue[Part] = asyncio.Queue(MOST_BEHIND)
        self._is_ended = False

    def put(self, part: Part) -> None:
        """Add a part; a reader that is too far behind gets no more."""
        try:
            self._parts.put_nowait(part)
        except asyncio.QueueFull:
            self._is_ended = True

    async def take(self) -> Part | None:
        """Return the next part, a comment after `HEARTBEAT` seconds, None at the end."""
        if self._is_ended:
            return None
        try:
            return await asyncio.wait_for(self._parts.get(), HEARTBEAT)
        except asyncio.TimeoutError:
            return _COMMENT


class Broadcast:
    """Passes each change to all readers; encodes it once."""

    def __init__(self) -> None:
        self._readers: set[Reader] = set()

    def check_room(self) -> None:
        """Refuse one more reader; raises `Busy`."""
        if len(self._readers) >= MOST_READERS:
            raise Busy(f"{MOST_READERS} readers follow the changes already; try again later")

    @contextmanager
    def reader(self) -> Iterator[Reader]:
        """Yield a reader that gets all changes from now on."""
        one = Reader()
        self._readers.add(one)
        try:
            yield one
        finally:
            self._readers.discard(one)

    def send(self, part: Part) -> None:
        """Pass a part to all readers."""
        for one in self._readers:
            one.put(part)

    def send_reset(self) -> None:
        """Announce that sequences begin again, in a new journal."""
        self.send(_RESET_PART)

    def send_events(self, rows: Sequence[EventRow]) -> None:
        """Pass new events."""
        if self._readers:
            self.send(_events(rows))


class Changes:
    """Endpoint that streams changes."""

    def __init__(self, gateway: Gateway) -> None:
        self._gateway = gateway

    async def follow(
        self,
        after: Annotated[
            int,
            Query(ge=0, le=LARGEST_NUMBER, description="Sequence before the first event; 0: none."),
        ] = 0,
        last_event_id: Annotated[
            str, Header(pattern=_ID, description="`id` of the last event, of a browser.")
        ] = "0",
    ) -> Response:
        """Stream new events and changes of the master's state, as server-sent events.

        `event: event` has an event as /v1/events lists it; its `id` begins with its sequence.
        `event: master` has `state` and `reason`, first and after each change. `event: gap` says
        that events were left out, because there were too many. `event: reset` says that the master
        has a new journal, whose sequences begin again; its events follow.
        """
        self._gateway.broadcast.check_room()
        sequence, _, moment = last_event_id.partition("-")
        stream = self._stream(int(sequence) or after, int(moment or 0))
        return StreamingResponse(stream, media_type="text/event-stream")

    async def _stream(self, after: int, moment: int) -> AsyncIterator[bytes]:
        with self._gateway.broadcast.reader() as reader:
            yield _joined(master_part(self._gateway.watcher.master))
            if after:
                try:
                    missed = await self._missed(after, moment)
                except RosrmError:
                    return  # the reader comes again with the same sequence
                yield _joined(missed)
                before = 0 if missed[:1] == _RESET_PART else after
                after = max([before, *(number for number, _ in missed)])
            while (part := await reader.take()) is not None:
                after = 0 if part == _RESET_PART else after
                yield _joined(part, after)

    async def _missed(self, after: int, moment: int) -> Part:
        """Return the events after a sequence, or those of a new journal after `RESET`.

        Args:
            after: sequence of an event that the reader has.
            moment: ms of its unix time; 0: unknown.
        """
        listing = await self._list(after - 1)
        rows = listing.events
        has_last = bool(rows) and rows[0].sequence == after
        is_other = has_last and moment not in (0, _moment(rows[0]))
        if listing.last_sequence < after or is_other:
            return _RESET_PART + _events((await self._list(0)).events)
        return _events(rows[has_last:], is_cut=bool(rows) and not has_last)

    async def _list(self, after: int) -> Listing:
        def ask(client: Client) -> Listing:
            return client.list(events=True, after=after, newest=MOST_EVENTS, on_wait=give_up_early)

        return await self._gateway.ask(self._gateway.reading, ask)


def _joined(part: Part, after: int = 0) -> bytes:
    """Return the content of a part without events up to a sequence."""
    return b"".join(content for number, content in part if not 0 < number <= after)


def _events(rows: Sequence[EventRow], *, is_cut: bool = False) -> Part:
    """Return events as a part of the stream; `is_cut`: events before them are missing."""
    parts = [(row.sequence, _encoded("event", json_forms.form(row), _id(row))) for row in rows]
    if parts and (is_cut or len(parts) >= MOST_EVENTS):
        parts.insert(0, (0, _encoded("gap", {"before": parts[0][0]})))
    return tuple(parts)


def _id(row: EventRow) -> str:
    return f"{row.sequence}-{_moment(row)}"


def _moment(row: EventRow) -> int:
    return round(1e3 * row.wall_time)


def master_part(master: MasterState) -> Part:
    """Return the state of the master as a part of the stream."""
    return ((0, _encoded("master", asdict(master))),)


def _encoded(kind: str, value: Any, event_id: str = "") -> bytes:
    number = f"id: {event_id}\n" if event_id else ""
    data = json.dumps(json_forms.finite(value))  # without line breaks, which would end the field
    return f"event: {kind}\n{number}data: {data}\n\n".encode()


_RESET_PART: Final[Part] = ((RESET, _encoded("reset", {})),)
