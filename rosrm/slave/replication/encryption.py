"""Encryption of snapshots for other hosts: XChaCha20-Poly1305 under the key of the process.

An encrypted replica has the format of a snapshot file with another magic. Its two blocks are a
random nonce and the encrypted snapshot file. So a host that stores the replica sees process,
instance, sequence and size, and can neither read nor change the state.
docs/reference/protocol.md has the format.
"""

from __future__ import annotations

import os
import struct
import zlib
from pathlib import Path
from typing import Final

from nacl.bindings import (
    crypto_aead_xchacha20poly1305_ietf_decrypt,
    crypto_aead_xchacha20poly1305_ietf_encrypt,
)
from nacl.exceptions import CryptoError

from rosrm.snapshots.format import Block, Damaged, Head, checked, encoded_head
from rosrm.snapshots.reader import read
from rosrm.snapshots.writer import check_origin

_NONCE_BYTES: Final = 24
#: Version of the encryption, instance, sequence; the name of the process follows.
_FACTS: Final = struct.Struct("<16sQQ")
_VERSION: Final = b"rosrm snapshot 1"


def encrypted(key: bytes, head: Head, content: bytes) -> bytes:
    """Return a snapshot as an encrypted replica.

    Args:
        key: of the process.
        head: header of the snapshot.
        content: the whole file of the snapshot.
    """
    nonce = os.urandom(_NONCE_BYTES)
    sealed = crypto_aead_xchacha20poly1305_ietf_encrypt(content, _facts_of(head), nonce, key)
    blocks = [Block(part, zlib.crc32(part)) for part in (nonce, sealed)]
    first = encoded_head(head.process, head.instance, head.sequence, blocks, encrypted=True)
    return b"".join([first, nonce, sealed])


def decrypted(key: bytes, path: Path) -> bytes:
    """Return the snapshot file in an encrypted replica.

    Raises:
        Damaged: the replica is not encrypted, not with this key, or was changed.
    """
    replica = read(path)
    head = replica.head
    if not head.encrypted:
        raise Damaged("it is not encrypted, and this process has a key")
    if len(head.blocks) != 2 or head.blocks[0][0] != _NONCE_BYTES:
        raise Damaged("it has other parts than an encrypted replica")
    nonce, sealed = replica.blocks
    try:
        content: bytes = crypto_aead_xchacha20poly1305_ietf_decrypt(
            sealed, _facts_of(head), nonce, key
        )
    except (ValueError, CryptoError):  # a ValueError: the part is shorter than a tag
        raise Damaged("it was changed, or encrypted with another key") from None
    check_origin(checked(content)[0], head.process, head.age)
    return content


def _facts_of(head: Head) -> bytes:
    """Return the associated data, which bind the state to its process, instance and sequence."""
    return _FACTS.pack(_VERSION, head.instance, head.sequence) + head.process.encode()
