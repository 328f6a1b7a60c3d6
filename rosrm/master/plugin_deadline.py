"""Deadlines for calls of plugins, so that an endless loop in one cannot block the master."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from functools import partial
from typing import TypeVar

from rosrm.errors import PluginError, describe_plugin_fault
from rosrm.extensions.plugin_calls import Plugin
from rosrm.extensions.time_limit import CALL_LIMIT, limited

T = TypeVar("T")


class Deadlines:
    """Deadline for each call of each plugin.

    The core treats a late call like any other failure, and decides without the plugin. A plugin
    that was late is not called again for a while. Otherwise the master would wait for the plugin at
    every reading, and neglect its slaves.

    Args:
        seconds: time limit of one call.
        pause: seconds for which a plugin is not called after a late call.

    Attributes:
        spent: seconds that all calls took so far.
    """

    def __init__(self, seconds: float = CALL_LIMIT, pause: float = 30.0) -> None:
        self._seconds = seconds
        self._pause = pause
        self._late: dict[Plugin, tuple[float, str]] = {}
        self.spent = 0.0
        if threading.current_thread() is not threading.main_thread():
            raise RuntimeError("the deadlines work by a signal and need the main thread")

    def __call__(self, plugin: Plugin, call: Callable[[], T]) -> T:
        """Return the answer of a call; raises `PluginError` or the plugin's own exception."""
        late_at, fault_text = self._late.get(plugin, (float("-inf"), ""))
        began = time.monotonic()
        if began - late_at < self._pause:
            raise PluginError(fault_text)
        try:
            return limited(self._seconds, call, partial(self._expired, plugin))
        except TimeoutError as fault:
            if plugin in self._late:  # name the code that was running at the deadline
                fault_text = describe_plugin_fault(fault)
                self._late[plugin] = (self._late[plugin][0], fault_text)
            raise
        except KeyboardInterrupt as fault:  # of the plugin: Ctrl-C raises nothing in a master
            raise PluginError(describe_plugin_fault(fault)) from fault
        finally:
            self.spent += time.monotonic() - began

    def _expired(self, plugin: Plugin) -> str:
        reason = (
            f"it took longer than {self._seconds:g} s for one decision, and is not asked again "
            f"for {self._pause:g} s"
        )
        self._late[plugin] = (time.monotonic(), reason)
        return reason
