"""A time limit for one call of a plugin, by the real-time interval timer of the process."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable
from types import FrameType
from typing import Final, TypeVar

T = TypeVar("T")

#: Seconds for a call of a policy or strategy by the master.
CALL_LIMIT: Final = 1.0
#: Seconds between two alarms, for a plugin that catches the first.
_AGAIN: Final = 0.05


def limited(seconds: float, call: Callable[[], T], late: Callable[[], str]) -> T:
    """Return the answer of a call; only the main thread has a limit, because signals go there.

    A loop inside C code that never returns to Python cannot be interrupted.

    Raises:
        TimeoutError: the time was up; the text is that of `late`.
    """
    if threading.current_thread() is not threading.main_thread():
        return call()
    running = True

    def expired(_signal: int, _frame: FrameType | None) -> None:
        if running:  # otherwise the call ended at the last moment
            raise TimeoutError(late())

    # A process has one timer: restore that of a test runner or an outer limit afterwards.
    before = signal.signal(signal.SIGALRM, expired)
    left, interval = signal.setitimer(signal.ITIMER_REAL, seconds, _AGAIN)
    try:
        return call()
    finally:
        running = False
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        if left:
            signal.signal(signal.SIGALRM, before)
            signal.setitimer(signal.ITIMER_REAL, left, interval)
