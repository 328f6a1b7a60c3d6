"""BLAKE2b of libsodium, which is loaded anyway; `hashlib` would add OpenSSL, 1 MiB."""

from __future__ import annotations

from nacl.bindings import crypto_generichash_blake2b_salt_personal, sodium_memcmp

#: Compare two digests in a time that does not depend on their content.
are_equal = sodium_memcmp


def digest_of(content: bytes, size: int, person: bytes, key: bytes = b"") -> bytes:
    """Return a digest.

    Args:
        content: to hash.
        size: of the digest, in bytes.
        person: separates this use of BLAKE2b from every other one; at most 16 bytes.
        key: without it, no holder of a key can forge the digest; b"": everybody can compute it.
    """
    return crypto_generichash_blake2b_salt_personal(content, size, key, person=person)
