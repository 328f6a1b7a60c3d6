"""Sealing of messages: ChaCha20-Poly1305 (RFC 8439), with a separate key for each use.

A key belongs to one direction (a principal to the master, or back), one run of the sender and one
channel (a topic, or the requests or answers of a service). So a message does not open on another
channel, at another receiver or for another run, and the sender's counter is a nonce that never
repeats. Messages of one sender on one channel arrive in order. So a message is a repetition if its
counter is not above the counter of the newest message.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass, field
from enum import Enum
from typing import Final

# The functions of `nacl.bindings` take 4 us for a reading, those of libsodium 1 us, and a master
# with a thousand slaves opens thousands of readings a second. The import of `nacl.bindings`
# initializes libsodium.
from nacl._sodium import ffi, lib
from nacl.bindings import crypto_aead_chacha20poly1305_ietf_KEYBYTES as KEY_BYTES

from rosrm.keys.derivation import derived
from rosrm.keys.hashing import digest_of

#: Version of the sealing, unencrypted in each message.
FORMAT: Final = 1
#: Bytes that sealing adds to a message: the tag of Poly1305.
OVERHEAD: Final = 16
#: Random bytes that identify a run of a sender, generated at its start.
RUN_BYTES: Final = 16
#: Largest counter. The first is 1.
LAST_COUNTER: Final = 2**64 - 1

# Looked up once, because a master opens thousands of messages a second.
_decrypt: Final = lib.crypto_aead_chacha20poly1305_ietf_decrypt
_from_buffer: Final = ffi.from_buffer
_NULL: Final = ffi.NULL
#: Packs 0 and the counter of a message into its nonce.
_pack_nonce: Final = struct.Struct("<IQ").pack


class Direction(str, Enum):
    """Direction of the messages that a key seals."""

    TO_MASTER = "to the master"
    FROM_MASTER = "from the master"
    TO_PEER = "to a peer"
    FROM_PEER = "from a peer"


def channel_of(name: str, type_name: str) -> bytes:
    """Return the channel of a topic or service: 16 bytes that its name and type determine.

    Args:
        name: fully qualified, for example "/rosrm/submit".
        type_name: for example "rosrm_msgs/srv/Submit_Request"; requests and answers of a service
            are two channels.
    """
    text = f"{name}\0{type_name}".encode()
    return digest_of(text, 16, b"rosrm channel")


def channel_key(principal_key: bytes, direction: Direction, run: bytes, channel: bytes) -> bytes:
    """Return the key of one channel.

    Args:
        principal_key: key of a principal, ticket, instance or handoff.
        direction: direction of the messages.
        run: run of the sender, `RUN_BYTES`.
        channel: see `channel_of`.
    """
    return derived(principal_key, direction.value, run, channel)


def _check_key(key: bytes) -> None:
    """Raise `ValueError` for a key of another length; libsodium would read beyond its end."""
    if len(key) != KEY_BYTES:
        raise ValueError(f"a key must have {KEY_BYTES} bytes, this one has {len(key)}")


@dataclass(slots=True)
class Sealer:
    """Seals the messages of one channel.

    Attributes:
        counter: counter of the last sealed message; 0 before the first.
    """

    _key: bytes = field(repr=False)
    counter: int = 0

    def __post_init__(self) -> None:
        """Check the key."""
        _check_key(self._key)

    def seal(self, plaintext: bytes, context: bytes = b"") -> bytes:
        """Return the sealed message, `OVERHEAD` bytes longer; send `counter` beside it.

        Args:
            plaintext: the message.
            context: associated data, which the receiver needs to open the message.
        """
        self.counter += 1
        sealed = bytearray(len(plaintext) + OVERHEAD)
        lib.crypto_aead_chacha20poly1305_ietf_encrypt(
            _from_buffer(sealed), _NULL, plaintext, len(plaintext), context, len(context),
            _NULL, _pack_nonce(0, self.counter), self._key,
        )  # fmt: skip
        return bytes(sealed)


@dataclass(slots=True)
class Opener:
    """Opens the messages of one channel, each once and in order.

    Attributes:
        newest: counter of the newest opened message; 0 before the first.
    """

    _key: bytes = field(repr=False)
    newest: int = 0

    def __post_init__(self) -> None:
        """Check the key."""
        _check_key(self._key)

    def open(self, counter: int, sealed: bytes, context: bytes = b"") -> bytes | None:
        """Return the plaintext; None if the message is forged or repeated."""
        size = len(sealed)
        if not self.newest < counter <= LAST_COUNTER or size < OVERHEAD:
            return None
        plaintext = bytearray(size - OVERHEAD)
        failed = _decrypt(
            _from_buffer(plaintext), _NULL, _NULL, sealed, size, context, len(context),
            _pack_nonce(0, counter), self._key,
        )  # fmt: skip
        if failed:
            return None
        self.newest = counter
        return bytes(plaintext)
