"""Digests of process specs, by which a client names specs that the master has already.

A file is often applied or planned without a change, and the conversion of a thousand specs to
messages and back takes longer than all else. So a client first sends the digest alone.
"""

from __future__ import annotations

import json
from hashlib import sha256
from typing import Any, Final

from rosrm.model.codec import to_plain

#: Code of the refusal of a digest that the master does not know.
UNKNOWN_DIGEST: Final = "unknown_digest"
#: Letters of a digest.
LENGTH: Final = 64


def digest_of(value: Any) -> str:
    """Return the SHA-256 of a value as JSON with sorted keys, in hexadecimal digits."""
    return sha256(json.dumps(to_plain(value), sort_keys=True).encode()).hexdigest()
