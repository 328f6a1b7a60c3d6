"""The clocks of rosrm. No other module reads a clock of the machine; a rule of ruff checks this.

Durations, deadlines, leases and fences need a clock that is never set and never stops. Only the
boot clock is both: NTP sets the clock of the day, and `time.monotonic` stops while the
machine is suspended. All deadlines use the boot clock, so that two of them can be compared.
"""

from __future__ import annotations

import time


def boot_time() -> float:
    """Return the seconds since the start of this machine, with those in which it was suspended."""
    return time.clock_gettime(time.CLOCK_BOOTTIME)


def boot_time_ns() -> int:
    """Return `boot_time` in nanoseconds."""
    return time.clock_gettime_ns(time.CLOCK_BOOTTIME)


def awake_time() -> float:
    """Return seconds of a clock that stops while the machine is suspended.

    For the measurement of work, such as the duration of a call. Never compare it with `boot_time`.
    """
    return time.monotonic()


def suspended_time() -> float:
    """Return the seconds in which this machine was suspended since its start, or a moment less."""
    boot = boot_time()
    return boot - awake_time()


def wall_time() -> float:
    """Return the unix time, which may be set at any time: for schedules and displays."""
    return time.time()


def wall_time_ns() -> int:
    """Return `wall_time` in nanoseconds."""
    return time.time_ns()
