"""Rate of a counter over a sliding window."""

from __future__ import annotations

import math
from collections import deque
from typing import Final

#: Shortest interval in seconds. The kernel counts CPU time in steps of 10 ms, so a rate over less
#: time is noise.
_SHORTEST: Final = 0.02
#: Longest window in seconds.
_LONGEST: Final = 60.0


def check_window(window: float) -> None:
    """Raise `ValueError` for a window that is too long."""
    if window > _LONGEST:
        raise ValueError(f"`window` is {window:g} s; at most {_LONGEST:g} s")


class Rate:
    """Growth of a counter over the last `window` seconds.

    In one cycle of 0.1 s the CPU time of two cores has 20 steps, so a reading would jump by 5 %
    without any change of load. Over a second the rate is steady and still shows a new load at once.

    Args:
        window: seconds.
        at: time of the first count, seconds.
        count: value of the counter at that time.
        guess: rate to return until there is a second count.
    """

    def __init__(self, window: float, at: float, count: float, guess: float = 0.0) -> None:
        self._window = window
        self._counts: deque[tuple[float, float]] = deque([(at, count)])
        self._rate = guess

    def update(self, at: float, count: float) -> float:
        """Return the rate up to now, counts a second, >= 0; raises `ValueError` if not finite.

        Args:
            at: time by any steady clock, seconds.
            count: value of the counter now; a smaller one than before means a reset.
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
