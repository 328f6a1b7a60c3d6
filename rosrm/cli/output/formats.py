"""Numbers for people."""

from __future__ import annotations

import math
import time

from rosrm.wording import amount, size

__all__ = ["amount", "clock", "duration", "percent", "size", "words"]


def duration(seconds: float) -> str:
    """A span of time in at most two units: "0.4 s", "3 min", "2 h 5 min"."""
    if not math.isfinite(seconds):
        return "?"
    if seconds < 9.95:
        return f"{max(seconds, 0.0):.1f} s"
    if seconds < 120:
        return f"{seconds:.0f} s"
    minutes = int(seconds // 60)
    if minutes < 120:
        return f"{minutes} min"
    hours, minutes = divmod(minutes, 60)
    return f"{hours} h {minutes} min" if hours < 48 else f"{hours // 24} d"


def percent(fraction: float) -> str:
    """A fraction as whole percent, without the sign; "?" where it is not known."""
    return f"{fraction * 100:.0f}" if math.isfinite(fraction) else "?"


def clock(wall_time: float) -> str:
    """A time of day here."""
    return time.strftime("%H:%M:%S", time.localtime(wall_time))


def words(state: str) -> str:
    """A state without its underscore."""
    return state.replace("_", " ")
