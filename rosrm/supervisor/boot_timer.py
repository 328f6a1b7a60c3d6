"""A timer of the boot clock that a selector can wait for.

The time-out of a selector stops while the machine is suspended: a fence that expired in that
time would be seen too late by the whole rest of the wait. This timer fires at the resume.
"""

from __future__ import annotations

import os
import time
from typing import Final

from rosrm.shortage import raise_shortage
from rosrm.supervisor import own_log

_ABSOLUTE: Final = 1
#: Seconds; a later deadline is never reached, and might not fit in the kernel's structure.
_LATEST: Final = 2.0**32


class BootTimer:
    """A timer with one deadline.

    Attributes:
        descriptor: readable from the deadline on; -1: a filter of system calls refuses timers.

    Raises:
        OSError: the system has no room for a timer now.
    """

    def __init__(self) -> None:
        self.descriptor = -1
        self._deadline: float | None = None
        try:
            self._open()
        except (ImportError, OSError) as fault:
            if isinstance(fault, OSError):
                raise_shortage(fault)
            own_log.write(
                f"no timer of the boot clock: {fault}; after a suspend of this machine, fences may "
                "be late"
            )

    def _open(self) -> None:
        import ctypes  # noqa: PLC0415 - 1 MiB, which a supervisor without deadlines does not need

        libc = ctypes.CDLL(None, use_errno=True)
        flags = os.O_CLOEXEC | os.O_NONBLOCK
        self.descriptor = int(libc.timerfd_create(time.CLOCK_BOOTTIME, flags))
        if self.descriptor < 0:
            raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()))
        self._set_time, self._times = libc.timerfd_settime, ctypes.c_long * 4

    def set(self, deadline: float | None) -> None:
        """Set the deadline, by the boot clock; None: there is none."""
        if deadline == self._deadline or self.descriptor < 0:
            return
        self._deadline = deadline
        # 0 would switch the timer off, also for a deadline that is long past.
        nanoseconds = 0 if deadline is None else max(1, int(min(deadline, _LATEST) * 1e9))
        times = self._times(0, 0, *divmod(nanoseconds, 10**9))  # `struct itimerspec`, no period
        self._set_time(self.descriptor, _ABSOLUTE, times, None)

    def clear(self) -> None:
        """Take note that the deadline has passed."""
        self._deadline = None
        try:
            os.read(self.descriptor, 8)
        except BlockingIOError:  # it was set again in between
            return
