"""Deadlines for calls of plugins in a loop, so that none can block a master or a slave."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Final, TypeVar

from rosrm import clocks
from rosrm.errors import PluginError, describe_plugin_fault
from rosrm.extensions.guard import in_process
from rosrm.extensions.plugin_calls import Plugin, titled
from rosrm.extensions.time_limit import CALL_LIMIT, limited

T = TypeVar("T")

#: Share of the limit from which on a call counts as slow: a busy machine delays quick ones, too.
_SLOW: Final = 0.25
#: Limits that the slow calls of one plugin may take together; a tenth of the time is given back.
#: All calls in one turn of the loop may take as long, because a thousand of them may be quick.
#: With the default lease of 10 s a plugin holds the loop for half of it at most.
_MOST_SLOW: Final = 4.0
_GIVEN_BACK: Final = 0.1
#: Longest pause, as a multiple of the pause after the first late call; each further late call
#: doubles the pause.
_LONGEST: Final = 16.0


@dataclass(slots=True)
class _Account:
    """The late and slow calls of a plugin.

    Attributes:
        text: why it is not called.
        until: end of the pause.
        pause: seconds of the last pause; 0.0: the last call was in time.
        slow: seconds of slow calls, less what was given back until `at`.
    """

    text: str = ""
    until: float = 0.0
    pause: float = 0.0
    slow: float = 0.0
    at: float = 0.0


class Deadlines:
    """Deadline for each call of each plugin.

    The caller treats a late call like any other failure, and decides without the plugin. A plugin
    that was late, or often slow, is not called again for a while. Otherwise the loop would wait for
    the plugin at every reading, and neglect its peers.

    Args:
        seconds: time limit of one call.
        pause: seconds for which a plugin is not called after its first late call.

    Attributes:
        spent: seconds that all calls took so far.
    """

    def __init__(self, seconds: float = CALL_LIMIT, pause: float = 30.0) -> None:
        self._seconds = seconds
        self._pause = pause
        self._accounts: dict[Plugin, _Account] = {}
        self._in_turn: dict[Plugin, float] = {}
        self.spent = 0.0
        if threading.current_thread() is not threading.main_thread():
            raise RuntimeError("the deadlines work by a signal and need the main thread")

    def begin_turn(self) -> None:
        """Begin a turn of the loop, between which the part serves its peers."""
        self._in_turn.clear()

    def __call__(self, plugin: Plugin, call: Callable[[], T]) -> T:
        """Return the answer of a call; raises `PluginError` or the plugin's own exception."""
        account = self._accounts.get(plugin)
        began = clocks.awake_time()
        if account is not None and began < account.until:
            raise PluginError(account.text)
        if threading.current_thread() is not threading.main_thread():  # it holds no loop
            return in_process(titled(*plugin), "", call)
        late = partial(self._expired, plugin)
        try:
            guarded = partial(in_process, titled(*plugin), "", call, often=True)
            answer = limited(self._seconds, guarded, late)
        except TimeoutError as fault:  # name the code that was running at the deadline
            self._accounts[plugin].text = describe_plugin_fault(fault)
            raise
        finally:
            took = clocks.awake_time() - began
            self.spent += took
            in_turn = self._in_turn[plugin] = self._in_turn.get(plugin, 0.0) + took
            if took > self._seconds * _SLOW:
                self._charge(plugin, took)
            if in_turn > self._seconds * _MOST_SLOW:
                self._pause_because(plugin, in_turn)
        if account is not None and account.until < began:
            account.pause = 0.0
        return answer

    def _expired(self, plugin: Plugin) -> str:
        pause = self._begin_pause(plugin)
        return (
            f"it took longer than {self._seconds:g} s for one decision, and is not asked again "
            f"for {pause:g} s"
        )

    def _charge(self, plugin: Plugin, took: float) -> None:
        """Count a slow call; begin a pause if the plugin has held the loop for too long."""
        account, now = self._accounts.setdefault(plugin, _Account()), clocks.awake_time()
        account.slow = max(0.0, account.slow - (now - account.at) * _GIVEN_BACK) + took
        account.at = now
        if account.slow > self._seconds * _MOST_SLOW:
            self._pause_because(plugin, account.slow)

    def _pause_because(self, plugin: Plugin, took: float) -> None:
        """Begin a pause because of many calls, unless a late one has begun it."""
        account = self._accounts.setdefault(plugin, _Account())
        if account.until < clocks.awake_time():
            account.text = (
                f"its calls took {took:.1f} s within a short time, and it is not asked "
                f"again for {self._begin_pause(plugin):g} s"
            )

    def _begin_pause(self, plugin: Plugin) -> float:
        account = self._accounts.setdefault(plugin, _Account())
        doubled = min(account.pause * 2.0, self._pause * _LONGEST)
        account.pause = max(self._pause, doubled)
        account.until = clocks.awake_time() + account.pause
        return account.pause
