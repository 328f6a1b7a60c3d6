"""The clocks of rosrm. No other module reads a clock of the machine; a rule of ruff checks this.

Durations, deadlines, leases and fences need a clock that is never set and never stops. Only the
boot clock is such a clock: NTP sets the wall clock, and `time.monotonic` stops while the machine is
suspended. All times of a part are of the boot clock, so that two can be compared.

A time after which others act counts the time of a suspend. A time in which this machine has to do
something does not, because it does nothing while it is suspended: a core leaves out the seconds
that `Suspends` finds (its event `Slept`), and a wait that is compared with no other time uses
`awake_time`.

====================================================================  ======================
of a slave and its supervisor                                         counts
====================================================================  ======================
fence, and the SIGKILL that it requires (`kill_by`)                   boot time
lease of the slave, contact with the master, registration             boot time
back-off before a restart; run time of a job; ages in reports         boot time
repetition of orders and reports; acknowledgements of the master      boot time
graces of a stop (SIGINT, SIGTERM), also those of a whole slave       awake time (`Slept`)
readiness, loads of components, transitions of a lifecycle node       awake time (`Slept`)
fetch of an artifact or of a snapshot                                 awake time (`leave_out`)
health: one look counts a bounded share of its time-out               awake time
start that waits for a path; wait for a directory of state or logs     awake time
calls of plugins, launchers, probes                                   awake time
====================================================================  ======================
"""

from __future__ import annotations

import time
from typing import Final


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


class Suspends:
    """Suspends of this machine since the last call of `new`."""

    #: Seconds; the two clocks are not read at the same moment.
    LEAST: Final = 0.1

    def __init__(self) -> None:
        self._seen = suspended_time()

    def new(self) -> float:
        """Return the seconds of the suspends that were not returned yet; 0.0: there was none."""
        slept = suspended_time() - self._seen
        if slept < self.LEAST:
            return 0.0
        self._seen += slept
        return slept


def wall_time() -> float:
    """Return the unix time, which may be set at any time: for schedules and displays."""
    return time.time()


def wall_time_ns() -> int:
    """Return `wall_time` in nanoseconds."""
    return time.time_ns()
