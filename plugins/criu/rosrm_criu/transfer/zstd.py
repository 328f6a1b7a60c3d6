"""Zstandard: Python's own module from 3.14 on, otherwise its backport."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Iterator
from typing import Final

if sys.version_info >= (3, 14):
    from compression.zstd import ZstdCompressor, ZstdDecompressor, ZstdError
else:
    from backports.zstd import ZstdCompressor, ZstdDecompressor, ZstdError

__all__ = ["ZstdDecompressor", "ZstdError", "compressed"]

#: The fastest regular level; a higher one is slower than a gigabit network.
_LEVEL: Final = 1


def compressed(pieces: Iterable[bytes]) -> Iterator[bytes]:
    """Yield the pieces as one compressed frame, in pieces of any size."""
    compressor = ZstdCompressor(level=_LEVEL)
    for piece in pieces:
        if packed := compressor.compress(piece):
            yield packed
    yield compressor.flush()
