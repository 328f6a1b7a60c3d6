"""A table that is bounded, because its keys come from what users name."""

from __future__ import annotations

from typing import TypeVar

K = TypeVar("K")
V = TypeVar("V")


class Newest(dict[K, V]):
    """The newest entries, oldest first.

    Attributes:
        most: highest number of entries.
    """

    def __init__(self, most: int) -> None:
        super().__init__()
        self.most = most

    def put(self, key: K, value: V) -> K | None:
        """Enter a value as the newest one; return the key that was forgotten for it."""
        self.pop(key, None)
        self[key] = value
        if len(self) <= self.most:
            return None
        oldest = next(iter(self))
        del self[oldest]
        return oldest
