"""BLAKE2b digests by libsodium, because `hashlib` would load OpenSSL, too (1 MiB)."""

from __future__ import annotations

from typing import Final

# Not the function of `nacl.bindings`, whose checks take most of the time of a short digest.
from nacl._sodium import ffi, lib
from nacl.bindings import sodium_memcmp

_PERSON_BYTES: Final = 16

#: Return True if two digests are equal, in a time that does not depend on their content.
are_equal = sodium_memcmp


def digest_of(content: bytes, size: int, person: bytes, key: bytes = b"") -> bytes:
    """Return a digest.

    Args:
        content: to hash.
        size: of the digest, in bytes.
        person: separates this use of BLAKE2b from every other one; at most 16 bytes.
        key: secret; only its holders can compute the digest; b"": anyone can.

    Raises:
        ValueError: the size, or the length of the person or key, is out of range.
    """
    digest = bytearray(size)
    padded = person.ljust(_PERSON_BYTES, b"\0")  # libsodium reads all of its bytes
    if len(padded) > _PERSON_BYTES or lib.crypto_generichash_blake2b_salt_personal(
        ffi.from_buffer(digest), size, content, len(content), key, len(key), ffi.NULL, padded
    ):
        raise ValueError(
            f"no BLAKE2b digest: size {size}, person of {len(person)} and key of {len(key)} bytes; "
            f"allowed: size 1 to 64, person up to {_PERSON_BYTES}, key up to 64"
        )
    return bytes(digest)
