"""A link between a principal and the master: seals what one side says, opens what the other says.

A request is bound to the run of its receiver, and an answer to its request. So neither can be used
again after a restart of the receiver, or for another request.
"""

from __future__ import annotations

import struct
from collections import OrderedDict
from dataclasses import dataclass
from typing import Final, Protocol

from rosrm.keys.sealing import Direction, Opener, Sealer, channel_key

#: Runs of the other side whose newest counters are remembered: of a user, one for each command.
_RUNS: Final = 256


@dataclass(frozen=True, slots=True)
class SealedMessage:
    """A message as it is sent.

    Attributes:
        run: of the sender.
        counter: of the sender on this channel; the first is 1.
        body: the sealed message, `OVERHEAD` bytes longer than the plain one.
    """

    run: bytes
    counter: int
    body: bytes

    @property
    def reference(self) -> bytes:
        """The bytes to which an answer to this message is bound."""
        return self.run + struct.pack("<Q", self.counter)


class Link(Protocol):
    """Interface of both ends of a link."""

    def seal(self, channel: bytes, plaintext: bytes, context: bytes = b"") -> SealedMessage:
        """Return a message for the other side.

        Args:
            channel: see `rosrm.keys.sealing.channel_of`.
            plaintext: the message.
            context: of a request the run of the receiver, b"" while it is unknown; of an answer the
                `reference` of its request.
        """

    def open(self, channel: bytes, message: SealedMessage, context: bytes = b"") -> bytes | None:
        """Return a message of the other side; None: it is not genuine, or a repetition."""


class KeyedLink:
    """A link under the key of a principal.

    Args:
        key: of the principal.
        run: of this side.
        outward: direction of the messages that this side seals.
        inward: direction of those that it opens.
    """

    def __init__(self, key: bytes, run: bytes, outward: Direction, inward: Direction) -> None:
        self._key = key
        self._run = run
        self._outward = outward
        self._inward = inward
        self._sealers: dict[bytes, Sealer] = {}
        self._openers: OrderedDict[tuple[bytes, bytes], Opener] = OrderedDict()

    def seal(self, channel: bytes, plaintext: bytes, context: bytes = b"") -> SealedMessage:
        """Return a message for the other side."""
        sealer = self._sealers.get(channel)
        if sealer is None:
            key = channel_key(self._key, self._outward, self._run, channel)
            sealer = self._sealers[channel] = Sealer(key)
        body = sealer.seal(plaintext, context)
        return SealedMessage(self._run, sealer.counter, body)

    def open(self, channel: bytes, message: SealedMessage, context: bytes = b"") -> bytes | None:
        """Return a message of the other side; None: it is not genuine, or a repetition."""
        opener = self._openers.get((message.run, channel))
        if opener is None:
            opener = Opener(channel_key(self._key, self._inward, message.run, channel))
        plaintext = opener.open(message.counter, message.body, context)
        if plaintext is None:
            return None
        self._remember(message.run, channel, opener)
        return plaintext

    def _remember(self, run: bytes, channel: bytes, opener: Opener) -> None:
        """Remember a run that has sent a genuine message: a stranger makes nothing be stored."""
        self._openers[run, channel] = opener
        self._openers.move_to_end((run, channel))
        if len(self._openers) > _RUNS:
            self._openers.popitem(last=False)


class OpenLink:
    """A link without keys, for `security: none`: the other side is believed."""

    def __init__(self, run: bytes) -> None:
        self._run = run
        self._counter = 0

    def seal(self, channel: bytes, plaintext: bytes, context: bytes = b"") -> SealedMessage:
        """Return a message for the other side, as it is."""
        del channel, context
        self._counter += 1
        return SealedMessage(self._run, self._counter, plaintext)

    def open(self, channel: bytes, message: SealedMessage, context: bytes = b"") -> bytes | None:
        """Return a message of the other side."""
        del channel, context
        return message.body
