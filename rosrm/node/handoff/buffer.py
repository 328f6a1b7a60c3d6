"""Input buffer of a shadow or a silent source, until one of them is active. Pure."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass, field
from enum import Enum
from math import inf
from typing import Any, Final, NamedTuple

#: Newest processed messages of each input that a source remembers. Its whole marks name all of
#: them, so a follower that has missed marks learns what these covered.
HISTORY: Final = 8192
#: Stored covered time stamps per input, for messages that arrive after their mark.
_REMEMBERED: Final = 2 * HISTORY
#: Stored orders of publishers per input.
_MOST_ORDERS: Final = 64


class Known(Enum):
    """Knowledge of the messages of an input that the source has processed.

    GAP: marks are missing; the next whole mark names what they covered.
    LOST: the source does not remember all of it any more.
    """

    ALL = "all"
    GAP = "gap"
    LOST = "lost"


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
        order: of its publisher.
        number: of the received messages of its input.
    """

    topic: str
    stamp: int
    item: Any
    size: int
    order: _Order
    number: int


@dataclass(slots=True, eq=False)
class _Order:
    """Received messages with consecutive numbers, so of one publisher.

    Attributes:
        last: number of the last one.
        after_gap: a message of this publisher may be missing. A state that covers a later one
            covers that too, because the source receives each publisher's messages in order.
        broken: the next message may be of another publisher, because a message was missing since.
    """

    last: int | None
    after_gap: bool = False
    broken: bool = False


@dataclass(slots=True)
class _Track:
    """State of one input.

    Attributes:
        covered: newest covered time stamps, in the order in which they were reported.
        newest: newest covered time stamp; None: none was covered.
        mixed: time stamps may decrease: several publishers, or one restarted with its clock behind.
        unordered: several threads take the messages, so that numbers show no loss.
        overlap: a message was received that the source has processed too.
        arrived_at: arrival of the last message, here or at the source, seconds.
        held: messages in the buffer.
        received: messages received so far.
        last: time stamp of the last one.
        orders: of the publishers.
        processed: position of the newest message that a mark has named.
        known: position up to which marks have named all processed messages that came or may come
            here; None: the source may have forgotten one of them.
        doubtful: number of the last received message that the source may have processed and
            forgotten: what came before the first whole mark. None: there was none.
        overrun: number of the last received message when the reader was full; 0: it never was;
            infinite: it was full during the switch.
    """

    arrived_at: float
    covered: dict[int, None] = field(default_factory=dict)
    newest: int | None = None
    mixed: bool = False
    unordered: bool = False
    overlap: bool = False
    held: int = 0
    received: int = 0
    last: int | None = None
    orders: list[_Order] = field(default_factory=list)
    processed: int = 0
    known: int | None = None
    doubtful: int | None = None
    overrun: float = 0


class InputBuffer:
    """Messages of all inputs, in order of arrival.

    Args:
        limit: most messages of one input.
        room: most bytes of all inputs together.
        now: monotonic seconds.

    Attributes:
        is_last: the source may be silent, and would not process a message that is lost here.
    """

    def __init__(self, limit: int, room: int, now: float) -> None:
        self._limit = limit
        self._room = room
        self._since = now
        self.is_last = False
        self._messages: deque[BufferedMessage] = deque()
        self._tracks: dict[str, _Track] = {}

    def _track(self, topic: str) -> _Track:
        track = self._tracks.get(topic)
        if track is None:
            track = self._tracks[topic] = _Track(self._since)
        return track

    def mix(self, topic: str) -> None:
        """Mark an input as unordered, because several threads take its messages."""
        track = self._track(topic)
        track.mixed = track.unordered = True

    def add(self, topic: str, sent: Sent, item: Any, now: float, size: int = 0) -> bool:
        """Add a message, unless a state covers it already; return False if there is no room."""
        track = self._track(topic)
        track.arrived_at = now
        order = _note_order(track, sent)
        if _is_covered(track, sent.stamp):
            track.overlap, order.after_gap = True, False
            return True
        if track.held >= self._limit or size > self._room:
            return False
        track.held += 1
        self._room -= size
        self._messages.append(BufferedMessage(topic, sent.stamp, item, size, order, track.received))
        return True

    def overran(self, topic: str) -> None:
        """Note that the reader was full, and may have dropped messages for those received last.

        Of one publisher the next number shows a loss; of several ones perhaps too late.
        """
        track = self._track(topic)
        track.overrun = inf if self.is_last else track.received

    def cover(
        self, topic: str, stamps: Iterable[int], *, processed: int, single: bool, now: float
    ) -> None:
        """Record that a state covers these messages; drop them now, or when they arrive.

        Args:
            processed: position of the last one; the others have the positions before.
            single: the topic has one publisher. So its stamps are in order, and the source skipped
                any message older than the newest covered one.
        """
        track = self._track(topic)
        stamps = list(stamps)
        track.mixed = track.mixed or not single or stamps != sorted(stamps)
        _note_history(track, processed, len(stamps))
        new = [stamp for stamp in stamps if stamp not in track.covered]
        if new:
            track.arrived_at = now
            track.covered.update(dict.fromkeys(new))
            track.newest = max(new if track.newest is None else [*new, track.newest])
            while len(track.covered) > _REMEMBERED:
                del track.covered[next(iter(track.covered))]
            self._drop_covered(topic, track)
        # Marks will name a message that the source has not processed yet, but no forgotten one.
        is_doubted = track.doubtful is None or self._holds(topic, track.doubtful)
        if track.known is None and not is_doubted:
            track.known = track.processed

    def _holds(self, topic: str, number: float) -> bool:
        """Return True if a received message up to this number is in the buffer."""
        return any(one.topic == topic and one.number <= number for one in self._messages)

    def _drop_covered(self, topic: str, track: _Track) -> None:
        if not track.held:
            return
        left: deque[BufferedMessage] = deque()
        for one in self._messages:
            if one.topic == topic and _is_covered(track, one.stamp):
                track.overlap, one.order.after_gap = True, False
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
        return track.last is None or track.last < track.newest

    def misses_one(self, topic: str) -> bool:
        """Return True if a sent message may not have arrived and no state covers it."""
        track = self._track(topic)
        if track.mixed and (track.overrun == inf or self._holds(topic, track.overrun)):
            return True
        return not track.unordered and any(order.after_gap for order in track.orders)

    def known(self, topic: str) -> Known:
        """Return the knowledge of the messages that the source has processed.

        With one publisher the newest one is enough, as all before it were processed or skipped.
        """
        track = self._track(topic)
        if not track.mixed or track.processed in (0, track.known):
            return Known.ALL
        is_lost = track.known is not None and track.processed - track.known > HISTORY
        return Known.LOST if is_lost else Known.GAP

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


def _note_order(track: _Track, sent: Sent) -> _Order:
    """Return the order that a received message belongs to."""
    last, track.last = track.last, sent.stamp
    track.received += 1
    track.mixed = track.mixed or (last is not None and sent.stamp < last)
    if sent.number is None:
        return _Order(None)
    found = next((one for one in track.orders if one.last == sent.number - 1), None)
    if found is not None:
        found.after_gap = found.after_gap or found.broken
        found.last, found.broken = sent.number, False
        return found
    found = _Order(sent.number, after_gap=bool(track.orders) and sent.number > 1)
    if found.after_gap:
        for one in track.orders:
            one.broken = True
    track.orders.append(found)
    if len(track.orders) > _MOST_ORDERS:
        track.orders.remove(min(track.orders, key=lambda one: one.after_gap))
    return found


def _note_history(track: _Track, processed: int, count: int) -> None:
    """Note the positions of the messages that a mark names."""
    before, track.processed = track.processed, processed
    unnamed = processed - count
    if unnamed <= (track.known or 0):
        track.known = processed
    elif track.known is None:
        if unnamed > before:
            track.doubtful = None  # this mark does not follow the one before
        if track.doubtful is None and count >= HISTORY:
            track.doubtful = track.received


def _is_covered(track: _Track, stamp: int) -> bool:
    if stamp in track.covered:
        return True
    return not track.mixed and track.newest is not None and stamp <= track.newest
