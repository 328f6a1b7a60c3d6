"""BLAKE2b digests by libsodium, because `hashlib` would load OpenSSL, too (1 MiB)."""

from __future__ import annotations

from nacl.bindings import crypto_generichash_blake2b_salt_personal, sodium_memcmp

#: Return True if two digests are equal, in a time that does not depend on their content.
are_equal = sodium_memcmp


def digest_of(content: bytes, size: int, person: bytes, key: bytes = b"") -> bytes:
    """Return a digest.

    Args:
        content: to hash.
        size: of the digest, in bytes.
        person: separates this use of BLAKE2b from every other one; at most 16 bytes.
        key: secret; only its holders can compute the digest; b"": anyone can.
    """
    return crypto_generichash_blake2b_salt_personal(content, size, key, person=person)
