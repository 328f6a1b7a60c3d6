"""Human-readable formats of numbers, times and states."""

from __future__ import annotations

import math
import time

from rosrm.wording import amount, duration, size

__all__ = ["amount", "clock", "duration", "percent", "size", "words"]


def percent(fraction: float) -> str:
    """Return a fraction in whole percent without the sign; "?" if it is unknown."""
    return f"{fraction * 100:.0f}" if math.isfinite(fraction) else "?"


def clock(wall_time: float) -> str:
    """Return a time of day in the local time zone."""
    return time.strftime("%H:%M:%S", time.localtime(wall_time))


def words(state: str) -> str:
    """Return the name of a state without underscores."""
    return state.replace("_", " ")
