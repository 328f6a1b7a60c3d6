"""Links: one end of the messages between two parties under one key.

A link seals the messages of its own side, and opens the messages of the other side. A request is
bound to the run of its receiver, and an answer to its request. So a recorded request has no effect
after a restart of the receiver, and a recorded answer does not open for another request.
"""

from __future__ import annotations

import struct
from collections import OrderedDict
from collections.abc import Callable
from typing import Final, NamedTuple, Protocol

from rosrm.keys.sealing import Direction, Opener, Sealer, channel_key

#: Pairs of run and channel whose newest counters are stored. Each command of a user has a new run.
_RUNS: Final = 256

#: Openers by run of the sender and channel, the least recently used first.
_Openers = OrderedDict[tuple[bytes, bytes], Opener]

#: Opens the messages of one run on one channel, given by counter, body and context.
OpenMessage = Callable[[int, bytes, bytes], bytes | None]


class SealedMessage(NamedTuple):
    """A message as it is sent.

    Attributes:
        run: run of the sender.
        counter: number of the message in that run on this channel; the first is 1.
        body: the sealed message, `OVERHEAD` bytes longer than the plain message.
    """

    run: bytes
    counter: int
    body: bytes

    @property
    def reference(self) -> bytes:
        """The associated data of an answer to this message."""
        return self.run + struct.pack("<Q", self.counter)


class Link(Protocol):
    """Interface of both ends of a link."""

    def seal(self, channel: bytes, plaintext: bytes, context: bytes = b"") -> SealedMessage:
        """Return a message for the other side.

        Args:
            channel: see `rosrm.keys.sealing.channel_of`.
            plaintext: the message.
            context: for a request, the run of the receiver; for an answer, the `reference` of its
                request.
        """

    def open(
        self, channel: bytes, message: SealedMessage, context: bytes = b"", *, is_bound: bool = True
    ) -> bytes | None:
        """Return a message of the other side; None if the message is forged or repeated.

        Args:
            is_bound: True for a message to this run of the receiver. Messages to former runs have
                no effect, but anyone can send recorded ones. The counters of both are stored apart;
                otherwise messages to former runs would displace the counters of this run.
        """

    def opener(self, channel: bytes, run: bytes) -> OpenMessage:
        """Return `open` for many messages of a run that has sent a genuine message."""


class KeyedLink:
    """A link under the key of a principal.

    Args:
        key: key of the principal.
        run: run of this side.
        outward: direction of the messages that this side seals.
        inward: direction of the messages that this side opens.
    """

    def __init__(self, key: bytes, run: bytes, outward: Direction, inward: Direction) -> None:
        self._key = key
        self._run = run
        self._outward = outward
        self._inward = inward
        self._sealers: dict[bytes, Sealer] = {}
        self._bound: _Openers = OrderedDict()
        self._unbound: _Openers = OrderedDict()

    def seal(self, channel: bytes, plaintext: bytes, context: bytes = b"") -> SealedMessage:
        """Return a message for the other side."""
        sealer = self._sealers.get(channel)
        if sealer is None:
            key = channel_key(self._key, self._outward, self._run, channel)
            sealer = self._sealers[channel] = Sealer(key)
        body = sealer.seal(plaintext, context)
        return SealedMessage(self._run, sealer.counter, body)

    def open(
        self, channel: bytes, message: SealedMessage, context: bytes = b"", *, is_bound: bool = True
    ) -> bytes | None:
        """Return a message of the other side; None if the message is forged or repeated."""
        openers = self._bound if is_bound else self._unbound
        opener = self._opener_in(openers, channel, message.run)
        plaintext = opener.open(message.counter, message.body, context)
        if plaintext is None:
            return None
        # After the check, because a message without a valid key must not use memory.
        _remember(openers, channel, message.run, opener)
        return plaintext

    def opener(self, channel: bytes, run: bytes) -> OpenMessage:
        """Return `open` for many messages of a run that has sent a genuine message."""
        opener = self._opener_in(self._bound, channel, run)
        _remember(self._bound, channel, run, opener)
        return opener.open

    def _opener_in(self, openers: _Openers, channel: bytes, run: bytes) -> Opener:
        known = openers.get((run, channel))
        return known or Opener(channel_key(self._key, self._inward, run, channel))


def _remember(openers: _Openers, channel: bytes, run: bytes, opener: Opener) -> None:
    openers[run, channel] = opener
    openers.move_to_end((run, channel))
    if len(openers) > _RUNS:
        openers.popitem(last=False)


class OpenLink:
    """A link without keys, for `security: none`: every message is accepted."""

    def __init__(self, run: bytes) -> None:
        self._run = run
        self._counter = 0

    def seal(self, channel: bytes, plaintext: bytes, context: bytes = b"") -> SealedMessage:
        """Return a message for the other side, unchanged."""
        del channel, context
        self._counter += 1
        return SealedMessage(self._run, self._counter, plaintext)

    def open(
        self, channel: bytes, message: SealedMessage, context: bytes = b"", *, is_bound: bool = True
    ) -> bytes | None:
        """Return a message of the other side."""
        del channel, context, is_bound
        return message.body

    def opener(self, channel: bytes, run: bytes) -> OpenMessage:
        """Return `open` for many messages of a run."""
        del channel, run
        return lambda _counter, body, _context: body
