"""Input buffer of a shadow or a silent source, until one of them is active. Pure."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any, Final, NamedTuple

#: Stored covered time stamps per input, for messages that arrive after their mark.
_REMEMBERED: Final = 4096


class Sent(NamedTuple):
    """Time and order of one sent message.

    Attributes:
        stamp: source time stamp, ns.
        number: position in its publisher's gapless order; None if unknown.
    """

    stamp: int
    number: int | None = None


class BufferedMessage(NamedTuple):
    """One message in the buffer.

    Attributes:
        topic: key of the input.
        stamp: source time stamp, ns.
        item: the message with all data needed to serve it.
        size: bytes.
    """

    topic: str
    stamp: int
    item: Any
    size: int


@dataclass(slots=True)
class _Track:
    """State of one input.

    Attributes:
        covered: newest covered time stamps, in the order in which they were reported.
        newest: newest covered time stamp; None: none was covered.
        mixed: time stamps may decrease: several publishers, or one restarted with its clock behind.
        overlap: a message was received that the source has processed too.
        arrived_at: arrival of the last message, here or at the source, seconds.
        held: messages in the buffer.
        last: the last message received of the one publisher.
        after_gap: time stamp of the message after a missing one; None: none is missing.
    """

    arrived_at: float
    covered: dict[int, None] = field(default_factory=dict)
    newest: int | None = None
    mixed: bool = False
    overlap: bool = False
    held: int = 0
    last: Sent | None = None
    after_gap: int | None = None


class InputBuffer:
    """Messages of all inputs, in order of arrival.

    Args:
        limit: most messages of one input.
        room: most bytes of all inputs together.
        now: monotonic seconds.
    """

    def __init__(self, limit: int, room: int, now: float) -> None:
        self._limit = limit
        self._room = room
        self._since = now
        self._messages: deque[BufferedMessage] = deque()
        self._tracks: dict[str, _Track] = {}

    def _track(self, topic: str) -> _Track:
        track = self._tracks.get(topic)
        if track is None:
            track = self._tracks[topic] = _Track(self._since)
        return track

    def mix(self, topic: str) -> None:
        """Mark an input as unordered, because several threads take its messages."""
        self._track(topic).mixed = True

    def add(self, topic: str, sent: Sent, item: Any, now: float, size: int = 0) -> bool:
        """Add a message, unless a state covers it already; return False if there is no room."""
        track = self._track(topic)
        track.arrived_at = now
        _note_order(track, sent)
        if _is_covered(track, sent.stamp):
            track.overlap = True
            return True
        if track.held >= self._limit or size > self._room:
            return False
        track.held += 1
        self._room -= size
        self._messages.append(BufferedMessage(topic, sent.stamp, item, size))
        return True

    def cover(self, topic: str, stamps: Iterable[int], *, single: bool, now: float) -> None:
        """Record that a state covers these messages; drop them now, or when they arrive.

        Args:
            single: the topic has one publisher. So its stamps are in order, and the source skipped
                any message older than the newest covered one.
        """
        track = self._track(topic)
        stamps = list(stamps)
        track.mixed = track.mixed or not single or stamps != sorted(stamps)
        new = [stamp for stamp in stamps if stamp not in track.covered]
        if not new:
            return
        track.arrived_at = now
        track.covered.update(dict.fromkeys(new))
        newest = max(new)
        track.newest = newest if track.newest is None else max(track.newest, newest)
        while len(track.covered) > _REMEMBERED:
            del track.covered[next(iter(track.covered))]
        self._drop_covered(topic, track)

    def _drop_covered(self, topic: str, track: _Track) -> None:
        if not track.held:
            return
        left: deque[BufferedMessage] = deque()
        for one in self._messages:
            if one.topic == topic and _is_covered(track, one.stamp):
                track.overlap = True
                track.held -= 1
                self._room += one.size
            else:
                left.append(one)
        self._messages = left

    def overlaps(self, topic: str) -> bool:
        """Return True if a received message is covered too; after that message none is missing."""
        return self._track(topic).overlap

    def is_behind(self, topic: str) -> bool:
        """Return True if the one publisher's newest covered message has not arrived here."""
        track = self._track(topic)
        if track.mixed or track.newest is None:
            return False
        return track.last is None or track.last.stamp < track.newest

    def misses_one(self, topic: str) -> bool:
        """Return True if a sent message has not arrived and no state covers it."""
        track = self._track(topic)
        if track.after_gap is None or track.mixed:
            return False
        return track.newest is None or track.newest < track.after_gap

    def is_idle(self, topic: str, now: float, since: float, for_seconds: float) -> bool:
        """Return True if the input is quiet: empty buffer, and no message for `for_seconds`.

        The quiet time begins at `since` at the earliest. Messages that reached only the source
        count too, because such a message may have been lost on its way here and arrive later.
        """
        track = self._track(topic)
        return not track.held and now - max(track.arrived_at, since) >= for_seconds

    def is_marked(self, topic: str, stamp: int) -> bool:
        """Return True if a mark has named exactly this message."""
        track = self._tracks.get(topic)
        return track is not None and stamp in track.covered

    def take(self) -> BufferedMessage | None:
        """Remove and return the oldest message; None: the buffer is empty."""
        if not self._messages:
            return None
        message = self._messages.popleft()
        self._tracks[message.topic].held -= 1
        self._room += message.size
        return message

    def __len__(self) -> int:
        """Return the number of waiting messages."""
        return len(self._messages)


def _note_order(track: _Track, sent: Sent) -> None:
    last, track.last = track.last, sent
    if last is None:
        return
    if sent.stamp < last.stamp:
        track.mixed = True
    elif last.number is not None and sent.number is not None and sent.number > last.number + 1:
        track.after_gap = sent.stamp


def _is_covered(track: _Track, stamp: int) -> bool:
    if stamp in track.covered:
        return True
    return not track.mixed and track.newest is not None and stamp <= track.newest
