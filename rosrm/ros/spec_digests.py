"""Digests of process specs, by which a client names specs that the master has already.

A file is often applied or planned with few changes, and the conversion of a thousand specs to
messages and back takes longer than all else. So a client first sends the digests alone, and then
the specs that the master lacks.
"""

from __future__ import annotations

import json
from collections.abc import Iterable
from hashlib import sha256
from itertools import chain, repeat
from typing import Any, Final

from rosrm.model.codec import to_plain

#: Code of the refusal of digests that the master does not know; the message has their positions.
UNKNOWN_DIGEST: Final = "unknown_digest"
#: Letters of a digest.
LENGTH: Final = 64


def digest_of(value: Any) -> str:
    """Return the SHA-256 of a value as JSON with sorted keys, in hexadecimal digits."""
    return sha256(json.dumps(to_plain(value), sort_keys=True).encode()).hexdigest()


def positions_to_text(lacking: Iterable[Iterable[int]]) -> str:
    """Return the positions of specs in each target as the message of a refusal: "0 2;;1"."""
    return ";".join(" ".join(map(str, positions)) for positions in lacking)


def positions_from_text(text: str, numbers: Iterable[int]) -> list[list[int]]:
    """Return the inverse of `positions_to_text`, of which a part may be cut off.

    `numbers`: of specs of each target.
    """
    parts = chain(text.split(";"), repeat(""))
    return [
        [int(one) for one in part.split() if one.isdecimal() and int(one) < number]
        for number, part in zip(numbers, parts, strict=False)
    ]
