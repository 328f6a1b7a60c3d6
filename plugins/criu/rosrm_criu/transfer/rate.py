"""Paces what is sent, so that others have the rest of the network. Pure."""

from __future__ import annotations

from typing import Final

#: Seconds of rest that may be caught up at once.
_SLACK: Final = 0.05


class Pace:
    """Spreads bytes evenly over time.

    Args:
        rate: bytes a second; 0: there is no bound.
    """

    def __init__(self, rate: float) -> None:
        self._rate = rate
        self._due = 0.0

    def wait(self, size: int, now: float) -> float:
        """Seconds to rest after so many bytes."""
        if not self._rate:
            return 0.0
        self._due = max(self._due, now - _SLACK) + size / self._rate
        return max(0.0, self._due - now)
