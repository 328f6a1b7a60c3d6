"""The rate of a counter over a sliding window."""

from __future__ import annotations

import math
from collections import deque
from typing import Final

#: The kernel counts CPU time in steps of 10 ms: over less than this a rate is noise.
_SHORTEST: Final = 0.02


class Rate:
    """How fast a counter grew over the last `window` seconds.

    Over one cycle of 0.1 s the CPU time of two cores has 20 steps, so that a reading would jump by
    5 % on its own; over a second it is steady, and still tells of a new load at once.

    Args:
        window: seconds.
        at: seconds, of the first count.
        count: of the counter then.
        guess: the rate to report until there is a second count.
    """

    def __init__(self, window: float, at: float, count: float, guess: float = 0.0) -> None:
        self._window = window
        self._counts: deque[tuple[float, float]] = deque([(at, count)])
        self._rate = guess

    def update(self, at: float, count: float) -> float:
        """The rate up to now, counts a second, >= 0.

        Args:
            at: seconds by any steady clock.
            count: of the counter now; one that has fallen was begun anew.
        """
        if not math.isfinite(count):
            raise ValueError(f"a counter says {count}")
        counts = self._counts
        if count < counts[-1][1]:
            counts.clear()
            counts.append((at, count))
            return self._rate
        if at - counts[0][0] < _SHORTEST:
            return self._rate
        while len(counts) > 1 and at - counts[1][0] >= self._window:
            counts.popleft()
        first_at, first_count = counts[0]
        self._rate = (count - first_count) / (at - first_at)
        if at - counts[-1][0] >= _SHORTEST:
            counts.append((at, count))
        return self._rate
