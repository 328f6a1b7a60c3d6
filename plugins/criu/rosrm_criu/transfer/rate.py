"""Rate limit for the sender, so that others can use the rest of the network. Pure."""

from __future__ import annotations

from typing import Final

#: Seconds of unused time that may be made up at once.
_SLACK: Final = 0.05


class Pace:
    """Rate limiter that spreads bytes evenly over time.

    Args:
        rate: bytes per second; 0: no bound.
    """

    def __init__(self, rate: float) -> None:
        self._rate = rate
        self._due = 0.0

    def wait(self, size: int, now: float) -> float:
        """Return the seconds to pause after sending `size` bytes."""
        if not self._rate:
            return 0.0
        self._due = max(self._due, now - _SLACK) + size / self._rate
        return max(0.0, self._due - now)
