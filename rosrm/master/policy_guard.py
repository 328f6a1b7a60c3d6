"""Ends a scoring policy that does not come back, so that a third party's loop cannot hang us."""

from __future__ import annotations

import signal
import threading
from types import FrameType

from rosrm.ports import HostView, ProcessView, Scores, ScoringPolicy


class GuardedPolicy:
    """A policy with a deadline, by the real-time interval timer; main thread only.

    The core treats the TimeoutError like any other failure: the policy is left out of that
    decision, and named. A loop inside C code that never returns to Python cannot be ended so.

    Args:
        name: of the policy, for the message.
        policy: the guarded one.
        deadline: seconds for one call.
    """

    def __init__(self, name: str, policy: ScoringPolicy, deadline: float = 1.0) -> None:
        self._name = name
        self._policy = policy
        self._deadline = deadline
        if threading.current_thread() is not threading.main_thread():
            raise RuntimeError("the guard works by a signal and needs the main thread")
        signal.signal(signal.SIGALRM, self._expired)

    def _expired(self, _signal: int, _frame: FrameType | None) -> None:
        raise TimeoutError(f"it took longer than {self._deadline:g} s for one decision")

    def score(self, hosts: HostView, process: ProcessView) -> Scores:
        """As the guarded policy, within its deadline."""
        signal.setitimer(signal.ITIMER_REAL, self._deadline)
        try:
            return self._policy.score(hosts, process)
        finally:
            signal.setitimer(signal.ITIMER_REAL, 0.0)
