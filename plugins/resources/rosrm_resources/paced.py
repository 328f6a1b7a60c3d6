"""Readings whose cost grows with the number of processes."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Final

#: Largest share of a core for one reading.
_SHARE: Final = 0.03
#: Seconds of CPU that are free: a reading of a few hundred processes is made each time.
_FREE: Final = 0.003


class Paced:
    """A reading that is made less often the more it costs; the last value counts in between.

    Args:
        read: returns the value at a time.
        clock: seconds.
    """

    def __init__(
        self, read: Callable[[float], float], clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._read, self._clock = read, clock
        self._costs = (0.0, 0.0)
        self._due = -1.0
        self._value = 0.0

    def value(self) -> float:
        """Return the value, from a new reading if one is due."""
        now = self._clock()
        if now < self._due:
            return self._value
        began = time.thread_time()
        self._value = self._read(now)
        self._costs = (self._costs[1], time.thread_time() - began)
        # A single slow reading, such as one with a garbage collection, says nothing.
        self._due = now + max(0.0, min(self._costs) - _FREE) / _SHARE
        return self._value
