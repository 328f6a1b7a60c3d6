"""Deadlines for the calls of plugins, so that a third party's loop cannot hang the master."""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Callable
from types import FrameType
from typing import Final, TypeVar

from rosrm.core.plugin_calls import Plugin
from rosrm.errors import PluginError, describe_plugin_fault

#: Seconds between two alarms, for a plugin that takes no notice of the first.
_AGAIN: Final = 0.05

T = TypeVar("T")


class Deadlines:
    """A deadline for each call of each plugin, by the real-time interval timer.

    The core treats a late call like any other failure: that decision is made without the plugin. A
    plugin that was late is not asked again for a while: a master that waits for it with every
    reading would have no time for its slaves. A loop inside C code that never returns to Python
    cannot be ended so. One of these serves a process, as a process has one such timer.

    Args:
        seconds: for one call.
        pause: seconds for which a plugin is not asked after a late call.

    Attributes:
        spent: seconds that all calls took so far.
    """

    def __init__(self, seconds: float = 1.0, pause: float = 30.0) -> None:
        self._seconds = seconds
        self._pause = pause
        self._asked: Plugin | None = None
        self._late: dict[Plugin, tuple[float, str]] = {}
        self.spent = 0.0
        if threading.current_thread() is not threading.main_thread():
            raise RuntimeError("the deadlines work by a signal and need the main thread")
        signal.signal(signal.SIGALRM, self._expired)

    def __call__(self, plugin: Plugin, call: Callable[[], T]) -> T:
        """Return the answer of a call; raises `PluginError` or what the plugin raised."""
        late_at, told = self._late.get(plugin, (float("-inf"), ""))
        began = time.monotonic()
        if began - late_at < self._pause:
            raise PluginError(told)
        self._asked = plugin
        signal.setitimer(signal.ITIMER_REAL, self._seconds, _AGAIN)
        try:
            return call()
        except TimeoutError as fault:
            if plugin in self._late:  # the pause says where the plugin was when the time was up
                told = describe_plugin_fault(fault)
                self._late[plugin] = (self._late[plugin][0], told)
            raise
        except KeyboardInterrupt as fault:  # of the plugin: Ctrl-C raises nothing in a master
            raise PluginError(describe_plugin_fault(fault)) from fault
        finally:
            self._asked = None
            signal.setitimer(signal.ITIMER_REAL, 0.0)
            self.spent += time.monotonic() - began

    def _expired(self, _signal: int, _frame: FrameType | None) -> None:
        if self._asked is None:  # the call ended in the very last moment
            return
        reason = (
            f"it took longer than {self._seconds:g} s for one decision, and is not asked again "
            f"for {self._pause:g} s"
        )
        self._late[self._asked] = (time.monotonic(), reason)
        raise TimeoutError(reason)
