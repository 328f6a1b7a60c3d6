"""Ends a scoring policy that does not come back, so that a third party's loop cannot hang us."""

from __future__ import annotations

import signal
import threading
import time
from types import FrameType
from typing import Final

from rosrm.ports import HostView, ProcessView, Scores, ScoringPolicy

#: Seconds between two alarms, for a policy that takes no notice of the first.
_AGAIN: Final = 0.05


class GuardedPolicy:
    """A policy with a deadline, by the real-time interval timer; main thread only.

    The core treats the TimeoutError like any other failure: the policy is left out of that
    decision, and named. One that was late is not asked again for a while: a master that waits for
    it with every reading would have no time for its slaves. A loop inside C code that never returns
    to Python cannot be ended so.

    Args:
        name: of the policy, for the message.
        policy: the guarded one.
        deadline: seconds for one call.
        pause: seconds for which it is not asked after it was late.
    """

    def __init__(
        self, name: str, policy: ScoringPolicy, deadline: float = 1.0, pause: float = 30.0
    ) -> None:
        self._name = name
        self._policy = policy
        self._deadline = deadline
        self._pause = pause
        self._asked = False
        self._late = float("-inf")
        if threading.current_thread() is not threading.main_thread():
            raise RuntimeError("the guard works by a signal and needs the main thread")
        signal.signal(signal.SIGALRM, self._expired)

    def _expired(self, _signal: int, _frame: FrameType | None) -> None:
        if self._asked:  # else it came back in the very last moment
            self._late = time.monotonic()
            raise self._too_late()

    def _too_late(self) -> TimeoutError:
        return TimeoutError(
            f"it took longer than {self._deadline:g} s for one decision, and is not asked again "
            f"for {self._pause:g} s"
        )

    def score(self, hosts: HostView, process: ProcessView) -> Scores:
        """As the guarded policy, within its deadline."""
        if time.monotonic() - self._late < self._pause:
            raise self._too_late()
        self._asked = True
        signal.setitimer(signal.ITIMER_REAL, self._deadline, _AGAIN)
        try:
            return self._policy.score(hosts, process)
        finally:
            self._asked = False
            signal.setitimer(signal.ITIMER_REAL, 0.0)
