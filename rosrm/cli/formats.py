"""Numbers for people."""

from __future__ import annotations

import math
import time
from typing import Final

_SIZES: Final = ("B", "kB", "MB", "GB", "TB", "PB")
_BINARY_SIZES: Final = ("B", "KiB", "MiB", "GiB", "TiB", "PiB")


def size(amount: float, *, binary: bool = False) -> str:
    """Bytes: "512 B", "64.1 MB"; in powers of 1024 "61.1 MiB"."""
    units, factor = (_BINARY_SIZES, 1024.0) if binary else (_SIZES, 1000.0)
    exponent = 0
    while abs(amount) >= factor - 0.5 and exponent < len(units) - 1:
        amount, exponent = amount / factor, exponent + 1
    digits = 0 if exponent == 0 or abs(amount) >= 99.5 else 1
    return f"{amount:.{digits}f} {units[exponent]}"


def amount(value: float, unit: str) -> str:
    """An amount of a resource in its base unit."""
    if not math.isfinite(value):
        return "?"
    if unit in ("B", "B/s"):
        return size(value) + unit[1:]
    return f"{value:.3g}" + {"core": " cores", "1": "", "": ""}.get(unit, f" {unit}")


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
