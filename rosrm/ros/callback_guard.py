"""Guard that keeps exceptions inside callbacks.

An exception that leaves a callback of rclpy's events executor ends the process, mostly by a
segmentation fault that names no cause. So rosrm catches all of them.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import Any, Final

from rosrm import clocks
from rosrm.errors import Refused, describe_fault, place_in_rosrm

_log = logging.getLogger("rosrm.callbacks")

#: Seconds between two log lines about the same place.
_LOGGED_EVERY: Final = 1.0


class CallbackGuard:
    """Calls callbacks; an exception is logged, and the caller continues.

    Attributes:
        interrupted: a Ctrl-C, or an exception of a signal handler, that arrived in a callback; the
            loop has to raise it.
        dropped: number of callbacks that failed, each with its message.
    """

    def __init__(self, clock: Callable[[], float] = clocks.boot_time) -> None:
        self.interrupted: BaseException | None = None
        self.dropped = 0
        self._clock = clock
        self._places: dict[str, tuple[float, int]] = {}

    def call(self, callback: Callable[..., Any], *arguments: Any) -> str:
        """Call a callback; return "" or the exception for the peer, without paths of this host."""
        try:
            callback(*arguments)
        except (Exception, SystemExit, GeneratorExit) as fault:  # noqa: BLE001 - the guard
            place = place_in_rosrm(fault)
            reason = f"{describe_fault(fault)} ({place})"
            self._note(place, getattr(callback, "__qualname__", str(callback)), reason)
            if isinstance(fault, Refused):  # its text is meant for peers
                return describe_fault(fault)
            return f"{type(fault).__name__}; its log has the cause"
        except BaseException as interrupt:  # noqa: BLE001 - nothing may reach the executor
            self.interrupted = interrupt  # caused by a signal, which may arrive only once
        return ""

    def raise_interrupt(self) -> None:
        """Raise the Ctrl-C or signal that arrived in a callback, if there was one."""
        if self.interrupted is not None:
            interrupt, self.interrupted = self.interrupted, None
            raise interrupt

    def _note(self, place: str, callback: str, reason: str) -> None:
        """Log a failure, at most once a second for each place."""
        self.dropped += 1
        now = self._clock()
        logged, unlogged = self._places.get(place, (float("-inf"), 0))
        if now - logged < _LOGGED_EVERY:
            self._places[place] = (logged, unlogged + 1)
            return
        more = f"; {unlogged} more since the last line" if unlogged else ""
        _log.error("callback %s failed, and its message was dropped: %s%s", callback, reason, more)
        self._places[place] = (now, 0)
