"""Numbers for people."""

from __future__ import annotations

import math
import time

from rosrm.wording import amount, duration, size

__all__ = ["amount", "clock", "duration", "percent", "size", "words"]


def percent(fraction: float) -> str:
    """A fraction as whole percent, without the sign; "?" where it is not known."""
    return f"{fraction * 100:.0f}" if math.isfinite(fraction) else "?"


def clock(wall_time: float) -> str:
    """A time of day here."""
    return time.strftime("%H:%M:%S", time.localtime(wall_time))


def words(state: str) -> str:
    """A state without its underscore."""
    return state.replace("_", " ")
