"""BLAKE2b by libsodium."""

import hashlib

import pytest

from rosrm.keys.hashing import digest_of


@pytest.mark.parametrize("key", [b"", bytes(range(32))])
@pytest.mark.parametrize("content", [b"", b"content", bytes(1000)])
def test_a_digest_is_that_of_hashlib(content, key) -> None:
    """Parts of another version compute the same keys, tags and channels."""
    by_hashlib = hashlib.blake2b(content, digest_size=16, person=b"a use", key=key)
    assert digest_of(content, 16, b"a use", key) == by_hashlib.digest()


@pytest.mark.parametrize(("size", "person", "key"), [(65, 16, 64), (16, 17, 64), (16, 16, 65)])
def test_what_libsodium_cannot_use_raises(size, person, key) -> None:
    """A value that is too long raises ValueError, and libsodium reads no bytes beyond it."""
    with pytest.raises(ValueError, match="no BLAKE2b digest"):
        digest_of(b"", size, bytes(person), bytes(key))
