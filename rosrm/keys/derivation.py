"""Derivation of keys: keyed BLAKE2b over a purpose and its arguments.

BLAKE2b with a key is a pseudo-random function (RFC 7693, section 2.9). So a derived key reveals
neither the key from which it is derived, nor other keys derived from that key.
"""

from __future__ import annotations

import struct
from typing import Final

from rosrm.keys.hashing import digest_of

#: Bytes of every secret key.
KEY_BYTES: Final = 32

#: Separates this use of BLAKE2b from every other one; at most 16 bytes.
_PERSON: Final = b"rosrm keys 1"


def derived(key: bytes, purpose: str, *arguments: str | int | bytes) -> bytes:
    """Return a key of `KEY_BYTES` for a purpose.

    Args:
        key: the cluster's secret, or a key that was derived from it.
        purpose: use of the derived key, for example "ticket".
        arguments: further values that distinguish the key. Each is preceded by its length, so that
            no two lists of arguments give the same bytes. A number has 64 bits.
    """
    parts = [_bytes_of(argument) for argument in (purpose, *arguments)]
    content = b"".join(struct.pack("<I", len(part)) + part for part in parts)
    return digest_of(content, KEY_BYTES, _PERSON, key)


def _bytes_of(argument: str | int | bytes) -> bytes:
    if isinstance(argument, str):
        return argument.encode("utf-8", "surrogatepass")
    if isinstance(argument, int):
        return struct.pack("<Q", argument)
    return argument
