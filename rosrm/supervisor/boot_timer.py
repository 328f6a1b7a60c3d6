"""A timer of the boot clock that a selector can wait for.

The time-out of a selector stands still while the machine is suspended: a fence that expired in that
time would be seen too late by the whole rest of the wait. This timer fires at the resume.
"""

from __future__ import annotations

import ctypes
import os
import time
from typing import Final

from rosrm.supervisor import own_log

_ABSOLUTE: Final = 1
#: Seconds; a later deadline is never reached, and might not fit in the kernel's structure.
_LATEST: Final = 2.0**32
_libc = ctypes.CDLL(None, use_errno=True)


class _Times(ctypes.Structure):
    """`struct itimerspec`: period, which stays 0, and time of expiry."""

    _fields_ = [(name, ctypes.c_long) for name in ("_s", "_ns", "seconds", "nanoseconds")]


class BootTimer:
    """A timer with one deadline.

    Attributes:
        descriptor: readable from the deadline on; -1: a filter of system calls refuses timers.
    """

    def __init__(self) -> None:
        flags = os.O_CLOEXEC | os.O_NONBLOCK
        self.descriptor = int(_libc.timerfd_create(time.CLOCK_BOOTTIME, flags))
        self._deadline: float | None = None
        if self.descriptor < 0:
            own_log.write(
                f"no timer of the boot clock: {os.strerror(ctypes.get_errno())}; after a suspend "
                "of this machine, fences may be late"
            )

    def set(self, deadline: float | None) -> None:
        """Set the deadline, by the boot clock; None: there is none."""
        if deadline == self._deadline or self.descriptor < 0:
            return
        self._deadline = deadline
        # 0 would switch the timer off, also for a deadline that is long past.
        nanoseconds = 0 if deadline is None else max(1, int(min(deadline, _LATEST) * 1e9))
        times = _Times(0, 0, *divmod(nanoseconds, 10**9))
        _libc.timerfd_settime(self.descriptor, _ABSOLUTE, ctypes.byref(times), None)

    def clear(self) -> None:
        """Take note that the deadline has passed."""
        self._deadline = None
        try:
            os.read(self.descriptor, 8)
        except BlockingIOError:  # it was set again in between
            return
