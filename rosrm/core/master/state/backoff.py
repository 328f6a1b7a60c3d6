"""Back-off of retries, and the memory of what has failed."""

from __future__ import annotations

from dataclasses import dataclass
from math import inf
from typing import Final

#: Failures in a row beyond which the wait is the longest one in any case.
_MOST: Final = 32


@dataclass(slots=True)
class Backoff:
    """Time of the next try; each failure in a row doubles the wait for it.

    Attributes:
        tries: failures in a row.
        until: time of the next try; -inf: at once.
    """

    tries: int = 0
    until: float = -inf

    def note(self, now: float, first: float, longest: float) -> float:
        """Note a failure; return the seconds until the next try.

        `first`, `longest`: wait after the first failure, and the longest one.
        """
        wait = min(first * 2.0**self.tries, max(first, longest))
        self.tries, self.until = min(self.tries + 1, _MOST), now + wait
        return wait
