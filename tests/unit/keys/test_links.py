"""Links between a principal and the master."""

from __future__ import annotations

import os

import pytest
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule

from rosrm.keys.links import KeyedLink, Link, OpenLink, SealedMessage
from rosrm.keys.sealing import RUN_BYTES, Direction, channel_of

KEY = bytes(range(32))
CHANNELS = [channel_of(f"/rosrm/{name}", "t") for name in ("submit", "cancel")]


def member(run: bytes = bytes(RUN_BYTES)) -> KeyedLink:
    """Return the end of a principal."""
    return KeyedLink(KEY, run, Direction.TO_MASTER, Direction.FROM_MASTER)


def master(run: bytes = bytes(RUN_BYTES)) -> KeyedLink:
    """Return the other end."""
    return KeyedLink(KEY, run, Direction.FROM_MASTER, Direction.TO_MASTER)


@pytest.mark.parametrize("ends", [(member(), master()), (OpenLink(b"a"), OpenLink(b"b"))])
def test_an_answer_belongs_to_its_request(ends: tuple[Link, Link]) -> None:
    """A request is bound to a run, and an answer to its request."""
    user, server = ends
    request = user.seal(CHANNELS[0], b"submit this", b"run of the master")
    assert server.open(CHANNELS[0], request, b"run of the master") == b"submit this"
    answer = server.seal(CHANNELS[1], b"queued", request.reference)
    assert user.open(CHANNELS[1], answer, request.reference) == b"queued"


def test_a_message_opens_only_where_it_was_sent() -> None:
    """Not on another channel, not at the sender, not under another context or key."""
    user, request = member(), member().seal(CHANNELS[0], b"x", b"run")
    assert master().open(CHANNELS[1], request, b"run") is None
    assert user.open(CHANNELS[0], request, b"run") is None
    assert master().open(CHANNELS[0], request, b"another run") is None
    other = KeyedLink(bytes(32), bytes(16), Direction.FROM_MASTER, Direction.TO_MASTER)
    assert other.open(CHANNELS[0], request, b"run") is None
    claimed = SealedMessage(os.urandom(16), request.counter, request.body)
    assert master().open(CHANNELS[0], claimed, b"run") is None
    assert master().open(CHANNELS[0], request, b"run") == b"x"


@pytest.mark.parametrize("ends", [(member(), master()), (OpenLink(b"a"), OpenLink(b"b"))])
def test_an_opener_opens_all_messages_of_a_run(ends: tuple[Link, Link]) -> None:
    """The master opens readings in this way."""
    slave, server = ends
    sent = [slave.seal(CHANNELS[0], text, b"run") for text in (b"one", b"two")]
    opened = server.opener(CHANNELS[0], sent[0].run)
    assert [opened(one.counter, one.body, b"run") for one in sent] == [b"one", b"two"]


def test_an_opener_and_the_link_open_each_message_once() -> None:
    """They share the newest counter, also after the link has made another opener."""
    slave, server = member(), master()
    first, second = (slave.seal(CHANNELS[0], text) for text in (b"one", b"two"))
    opened = server.opener(CHANNELS[0], first.run)
    assert opened(first.counter, first.body, b"") == b"one"
    assert server.open(CHANNELS[0], first) is None
    assert server.open(CHANNELS[0], second) == b"two"
    assert opened(second.counter, second.body, b"") is None
    again = server.opener(CHANNELS[0], first.run)
    assert again(second.counter, second.body, b"") is None


def test_recordings_of_former_runs_make_no_counter_be_forgotten() -> None:
    """A stranger may have recorded any number of them, and repeats them all at once."""
    end, sent = master(), member().seal(CHANNELS[0], b"x", b"this run")
    assert end.open(CHANNELS[0], sent, b"this run") == b"x"
    for _ in range(300):
        recorded = member(os.urandom(RUN_BYTES)).seal(CHANNELS[0], b"y", b"former run")
        assert end.open(CHANNELS[0], recorded, b"former run", is_bound=False) == b"y"
    assert end.open(CHANNELS[0], sent, b"this run") is None


class Conversation(RuleBasedStateMachine):
    """A principal restarts and sends; a stranger repeats, delays and changes all its messages."""

    @initialize()
    def begin(self) -> None:
        self.master = master()
        self.member = member(os.urandom(RUN_BYTES))
        self.seen: list[tuple[bytes, SealedMessage]] = []
        self.sent: set[bytes] = set()
        self.opened: list[bytes] = []
        self.number = 0

    @rule(channel=st.sampled_from(CHANNELS), arrives=st.booleans())
    def send(self, channel: bytes, *, arrives: bool) -> None:
        self.number += 1
        text = str(self.number).encode()
        message = self.member.seal(channel, text)
        self.seen.append((channel, message))
        self.sent.add(text)
        if arrives:
            self.receive(channel, message)
            assert self.opened[-1] == text

    @rule()
    def start_again(self) -> None:
        self.member = member(os.urandom(RUN_BYTES))

    @rule(data=st.data())
    def interfere(self, data: st.DataObject) -> None:
        if not self.seen:
            return
        channel, message = data.draw(st.sampled_from(self.seen))
        changed = SealedMessage(
            data.draw(st.sampled_from([message.run, bytes(RUN_BYTES)])),
            data.draw(st.sampled_from([message.counter, message.counter + 1, 2**64 - 1, 0])),
            data.draw(st.sampled_from([message.body, message.body[:-1], b"", message.body + b"0"])),
        )
        self.receive(data.draw(st.sampled_from([channel, *CHANNELS])), changed)

    def receive(self, channel: bytes, message: SealedMessage) -> None:
        text = self.master.open(channel, message)
        if text is not None:
            self.opened.append(text)

    @invariant()
    def nothing_is_opened_twice_or_invented(self) -> None:
        assert len(self.opened) == len(set(self.opened))
        assert self.sent.issuperset(self.opened)


TestConversation = Conversation.TestCase
