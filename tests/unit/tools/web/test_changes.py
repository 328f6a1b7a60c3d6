"""Streams of changes: bounds, and what a slow reader gets."""

from __future__ import annotations

import asyncio
import json

import pytest

from rosrm.model.rows import EventRow, Listing
from rosrm_web import changes
from rosrm_web.gateway import Gateway
from rosrm_web.watching import MOST_EVENTS


def row(sequence, message="text"):
    return EventRow(sequence, 0.0, 0.0, "submitted", "talker", "", message)


def test_a_slow_reader_is_dropped_and_others_are_not():
    """Its queue is bounded; the stream ends, and it may come again."""

    async def read():
        broadcast = changes.Broadcast()
        with broadcast.reader() as slow, broadcast.reader() as quick:
            taken = []
            for number in range(1, changes.MOST_BEHIND + 2):
                broadcast.send_events([row(number)])
                taken.append(await quick.take())
            return await slow.take(), taken

    slow, quick = asyncio.run(read())

    assert slow is None
    assert [part[0][0] for part in quick] == [*range(1, changes.MOST_BEHIND + 2)]


def test_a_stream_without_changes_has_comments(monkeypatch):
    """Proxies and readers see that the connection works."""
    monkeypatch.setattr(changes, "HEARTBEAT", 0.01)

    assert asyncio.run(changes.Reader().take()) == ((0, b":\n\n"),)


def test_text_cannot_end_a_field():
    """Line breaks of a message, also those of JavaScript, stay inside the JSON value."""
    broadcast = changes.Broadcast()
    with broadcast.reader() as reader:
        broadcast.send_events([row(7, "a\n\nevent: master\r\u2028<b>")])
        ((number, content),) = asyncio.run(reader.take())

    first, second, third, *rest = content.decode("ascii").split("\n")
    assert (number, first, second, rest) == (7, "event: event", "id: 7-0", ["", ""])
    assert json.loads(third.removeprefix("data: "))["message"] == "a\n\nevent: master\r\u2028<b>"


def test_left_out_events_are_announced():
    """One request brings a bounded number of events."""
    broadcast = changes.Broadcast()
    with broadcast.reader() as reader:
        broadcast.send_events([row(number) for number in range(11, 11 + MOST_EVENTS)])
        first, *events = asyncio.run(reader.take())

    assert first == (0, b'event: gap\ndata: {"before": 11}\n\n')
    assert len(events) == MOST_EVENTS


class Master:
    """A client of a master whose journal has events 1 to `last`, of this unix time."""

    def __init__(self, last, wall_time, *, first=1) -> None:
        self.first, self.last, self.wall_time = first, last, wall_time

    def list(self, *, after=0, newest=0, **_) -> Listing:
        numbers = range(max(self.first, after + 1), self.last + 1)[-(newest or 1000) :]
        rows = [EventRow(one, self.wall_time, 0.0, "submitted", "p", "", "") for one in numbers]
        return Listing("m", 1.0, self.last, events=rows)

    def master_load(self):
        """Return nothing: no load was published."""

    def close(self):
        """Leave nothing."""


async def streamed(master, number, *, after=0, last_event_id="0"):
    """Return the first changes behind the state of the master: kind and sequence."""
    gateway = Gateway(lambda _: master)
    await gateway.watcher.look()
    try:
        answer = await changes.Changes(gateway).follow(after, last_event_id)
        found = []
        async for content in answer.body_iterator:
            for one in content.decode().split("\n\n")[:-1]:
                kind, data = one.partition("\n")[0], json.loads(one.rpartition("data: ")[2])
                found.append((kind.removeprefix("event: "), data.get("sequence", 0)))
            if len(found) > number:
                break
        return found[1:]
    finally:
        gateway.close()


@pytest.mark.parametrize(
    ("master", "last_event_id", "expected"),
    [
        (Master(4, 5.0), "2-5000", [("event", 3), ("event", 4)]),
        (Master(4, 5.0), "2", [("event", 3), ("event", 4)]),
        (Master(2, 5.0), "4711-3000", [("reset", 0), ("event", 1), ("event", 2)]),
        (Master(2, 5.0), "2-3000", [("reset", 0), ("event", 1), ("event", 2)]),
        (Master(4, 5.0, first=3), "1-5000", [("gap", 0), ("event", 3), ("event", 4)]),
    ],
    ids=["same", "without a time", "shorter journal", "longer journal", "deleted events"],
)
def test_a_reader_that_returns_gets_what_it_missed(master, last_event_id, expected):
    """Events of a new journal follow a reset, and deleted events are announced as a gap."""
    assert asyncio.run(streamed(master, len(expected), last_event_id=last_event_id)) == expected


def test_a_new_journal_resets_an_open_stream():
    """Its events have sequences that the reader has seen in the former journal."""

    async def scene():
        master = Master(9, 5.0)
        gateway = Gateway(lambda _: master)
        await gateway.watcher.look()
        answer = await changes.Changes(gateway).follow(9, "0")
        stream = answer.body_iterator
        await anext(stream), await anext(stream)
        master.last = 2
        await gateway.watcher.look()
        await gateway.watcher.look()
        gateway.close()
        return [await anext(stream), await anext(stream)]

    reset, events = asyncio.run(scene())
    assert reset == b"event: reset\ndata: {}\n\n"
    assert events.count(b"event: event") == 2
