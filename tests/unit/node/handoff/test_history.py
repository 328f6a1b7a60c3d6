"""A handoff is played: publishers, stalls, lost messages and lost marks.

Each message is processed once, by the source or by the destination, or the handoff fails and says
why.
"""

from __future__ import annotations

from collections import Counter, deque
from random import Random
from types import SimpleNamespace

import pytest

from rosrm.node import entities
from rosrm.node.entities import Input
from rosrm.node.handoff import buffer as buffers
from rosrm.node.handoff.buffer import InputBuffer, Known, Sent
from rosrm.node.handoff.snapshot_assembler import CutAssembler, part_key

IN, STATE, DATA = "/in", "/state", b"state"
#: Most steps between the sending of a message and its arrival.
SLOWEST = 3
#: What the source remembers, and what it names in each mark.
HISTORY, NEWEST = 12, 3
PLAYS = 2000


@pytest.fixture(scope="module", autouse=True)
def small_numbers():
    """Reach the bounds of all histories within some steps."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(buffers, "HISTORY", HISTORY)
        patch.setattr(buffers, "_REMEMBERED", 2 * HISTORY)
        patch.setattr(entities, "HISTORY", HISTORY)
        patch.setattr(entities, "NEWEST", NEWEST)
        yield


class Way:
    """The way of one publisher's messages to one reader: in order, and each some steps late."""

    def __init__(self):
        self._sent = deque()
        self._last = 0

    def send(self, message, now, delay):
        self._last = max(self._last, now + delay)
        self._sent.append((self._last, message))

    def arrived(self, now):
        while self._sent and self._sent[0][0] <= now:
            yield self._sent.popleft()[1]


class Publisher:
    """Sends messages whose stamps are of its own clock."""

    def __init__(self, name, ahead):
        self.name, self.ahead, self.clock = name, ahead, -(10**6)
        self.number = 1000 * name  # rclpy does not tell whose number it is: equal ones hide a loss
        self.to_source, self.to_destination = Way(), Way()

    def send(self, now, delays, *, is_matched):
        self.number += 1
        self.clock = max((now + self.ahead) * 100, self.clock + 10)
        stamp = self.clock + self.name
        self.to_source.send(stamp, now, delays[0])
        if is_matched:
            self.to_destination.send(Sent(stamp, self.number), now, delays[1])
        return stamp


class Source:
    """Processes messages and publishes a mark after each."""

    def __init__(self, publishers, marks):
        self.input = Input(lambda message: None, False, True, True)
        self.publishers, self.marks = publishers, marks
        self.processed, self.is_attached = [], False

    def take(self, now):
        for publisher in self.publishers:
            for stamp in publisher.to_source.arrived(now):
                self.processed.append(stamp)
                self.input.serve(None, {"source_timestamp": stamp})
                if self.is_attached:
                    self.show(whole=False)

    def show(self, *, whole):
        key = part_key(DATA)
        part = SimpleNamespace(topic=STATE, size=key.size, digest=key.digest)
        covered = SimpleNamespace(
            topic=IN, covered=list(self.input.newest(whole=whole)), processed=self.input.processed
        )
        self.marks.append(
            SimpleNamespace(parts=[part], inputs=[covered], outputs=(), timers_due=())
        )


class Destination:
    """Takes messages and marks unless it is stalled; its readers keep the newest ones."""

    def __init__(self, publishers, marks, depth):
        self.publishers, self.marks = publishers, marks
        self.reader = deque(maxlen=depth)
        self.buffer = InputBuffer(100_000, 1 << 30, 0.0)
        self.assembler = CutAssembler()
        self.assembler.expect(STATE)
        self.assembler.add_part(STATE, DATA)
        self.processed = []

    def receive(self, now):
        for publisher in self.publishers:
            self.reader.extend(publisher.to_destination.arrived(now))

    def take(self, now):
        is_full = len(self.reader) == self.reader.maxlen
        while self.reader:
            self.buffer.add(IN, self.reader.popleft(), None, now)
        if is_full:
            self.buffer.overran(IN)
        while self.marks:
            self.assembler.add_mark(self.marks.popleft(), now)
        cut = self.assembler.take()
        for mark in (*cut.passed, cut.mark) if cut else ():
            (one,) = mark.inputs
            single = len(self.publishers) == 1
            self.buffer.cover(IN, one.covered, processed=one.processed, single=single, now=now)

    def is_ready(self):
        return (
            self.buffer.overlaps(IN)
            and self.buffer.known(IN) is Known.ALL
            and not self.buffer.misses_one(IN)
        )

    def refusal(self):
        if self.buffer.known(IN) is not Known.ALL:
            return "marks are missing"
        return "a message is missing" if self.buffer.misses_one(IN) else ""

    def activate(self):
        self.processed = [one.stamp for one in iter(self.buffer.take, None)]

    def serve(self, now):
        arriving = (sent for one in self.publishers for sent in one.to_destination.arrived(now))
        for stamp in (sent.stamp for sent in arriving):
            if not self.buffer.is_marked(IN, stamp):
                self.processed.append(stamp)


def play(seed):
    """Return why the handoff failed, "" if the node moved, and the sent and processed messages."""
    chance = Random(seed)
    publishers = [Publisher(name, chance.choice([-50, 0, 0, 4])) for name in range(1 + seed % 3)]
    marks = deque(maxlen=chance.randint(1, 8))
    source = Source(publishers, marks)
    destination = Destination(publishers, marks, depth=chance.randint(1, 20))
    joined = chance.randint(0, 30)
    attached = joined + chance.randint(0, 10)
    wanted = attached + SLOWEST + chance.randint(0, 15)
    busy = chance.choice([0, 1, 2, 4])
    sent, stalled_until = [], 0
    asked = silent = False
    for now in range(wanted + 40):
        if now >= stalled_until and chance.random() < 0.2:
            stalled_until = now + chance.randint(1, 12)
        for publisher in chance.choices(publishers, k=chance.randint(0, busy)):
            delays = chance.randint(0, 1), chance.randint(0, SLOWEST)
            sent.append(publisher.send(now, delays, is_matched=now >= joined))
        if not silent:
            source.take(now)
        if now == attached or (asked and not silent):
            source.is_attached, silent = True, asked
            source.show(whole=True)
        destination.receive(now)
        if now < max(joined, stalled_until):
            continue
        destination.take(now)
        if silent:
            break
        if now >= wanted and destination.is_ready():
            asked = destination.buffer.is_last = True
        elif destination.buffer.known(IN) is Known.GAP and now > attached:
            source.show(whole=True)
    else:
        return "it never became ready or active", [], []
    reason = destination.refusal()
    if not reason:
        destination.activate()
        for later in range(now, now + SLOWEST + 1):
            destination.serve(later)
    return reason, sent, source.processed + destination.processed


def test_each_message_is_processed_once_or_the_handoff_fails_with_a_reason():
    """The publishers have clocks of their own, and each way has delays of its own."""
    outcomes = Counter()
    for seed in range(PLAYS):
        reason, sent, processed = play(seed)
        outcomes[reason] += 1
        if not reason:
            assert sorted(processed) == sorted(sent), f"seed {seed}"
    assert outcomes[""] > PLAYS // 4
    assert len(outcomes) >= 3
