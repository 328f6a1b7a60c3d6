"""Time-out of a plugin call, by the real-time interval timer of the process."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable
from types import FrameType
from typing import Final, TypeVar

T = TypeVar("T")

#: Time-out of a call of a policy or strategy by the master, in seconds.
CALL_LIMIT: Final = 1.0
#: Seconds between two alarms, because a plugin may catch the first one.
_AGAIN: Final = 0.05


def limited(seconds: float, call: Callable[[], T], late: Callable[[], str]) -> T:
    """Return the answer of a call; only in the main thread, which gets signals, it has a time-out.

    A loop inside C code that never returns to Python cannot be interrupted.

    Raises:
        TimeoutError: the call took too long; the text is that of `late`.
    """
    if threading.current_thread() is not threading.main_thread():
        return call()
    running = True

    def expired(_signal: int, _frame: FrameType | None) -> None:
        if running:  # otherwise the call ended at the last moment
            raise TimeoutError(late())

    # A process has one timer, so that of a test runner or of an outer limit is restored afterwards.
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
