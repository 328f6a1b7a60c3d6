"""Zstandard: Python's own module from 3.14 on, and before that its backport."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Iterator
from typing import Final

if sys.version_info >= (3, 14):
    from compression.zstd import ZstdCompressor, ZstdDecompressor, ZstdError
else:
    from backports.zstd import ZstdCompressor, ZstdDecompressor, ZstdError

__all__ = ["ZstdDecompressor", "ZstdError", "compressed"]

#: The fastest of the ordinary levels: a higher one is slower than a gigabit network.
_LEVEL: Final = 1


def compressed(pieces: Iterable[bytes]) -> Iterator[bytes]:
    """The pieces as one frame, in pieces of no particular size."""
    compressor = ZstdCompressor(level=_LEVEL)
    for piece in pieces:
        if packed := compressor.compress(piece):
            yield packed
    yield compressor.flush()
