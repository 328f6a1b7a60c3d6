"""Streams of changes: bounds, and what a slow reader gets."""

from __future__ import annotations

import asyncio
import json

from rosrm.model.rows import EventRow
from rosrm_web import changes
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
    assert (number, first, second, rest) == (7, "event: event", "id: 7", ["", ""])
    assert json.loads(third.removeprefix("data: "))["message"] == "a\n\nevent: master\r\u2028<b>"


def test_left_out_events_are_announced():
    """One request brings a bounded number of events."""
    broadcast = changes.Broadcast()
    with broadcast.reader() as reader:
        broadcast.send_events([row(number) for number in range(11, 11 + MOST_EVENTS)])
        first, *events = asyncio.run(reader.take())

    assert first == (0, b'event: gap\ndata: {"before": 11}\n\n')
    assert len(events) == MOST_EVENTS
