"""Ends a policy that does not come back, so that a third party's loop cannot hang us."""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Callable
from types import FrameType
from typing import Any, Final, TypeVar

from rosrm.ports import (
    CheckpointChoice,
    CheckpointPolicy,
    CheckpointView,
    HostView,
    MemoryPacing,
    MemoryView,
    ProcessView,
    Scores,
    ScoringPolicy,
)

#: Seconds between two alarms, for a policy that takes no notice of the first.
_AGAIN: Final = 0.05

T = TypeVar("T")


class Deadline:
    """A deadline for calls of one policy, by the real-time interval timer; main thread only.

    The core treats the TimeoutError like any other failure: the policy is left out of that
    decision, and named. One that was late is not asked again for a while: a master that waits for
    it with every reading would have no time for its slaves. A loop inside C code that never returns
    to Python cannot be ended so.

    Args:
        seconds: for one call.
        pause: seconds for which it is not asked after it was late.
    """

    def __init__(self, seconds: float = 1.0, pause: float = 30.0) -> None:
        self._seconds = seconds
        self._pause = pause
        self._asked = False
        self._late = float("-inf")
        if threading.current_thread() is not threading.main_thread():
            raise RuntimeError("the guard works by a signal and needs the main thread")

    def call(self, ask: Callable[..., T], *arguments: Any) -> T:
        """What is answered in time; raises TimeoutError, or what was raised."""
        if time.monotonic() - self._late < self._pause:
            raise self._too_late()
        signal.signal(signal.SIGALRM, self._expired)  # there are other policies
        self._asked = True
        signal.setitimer(signal.ITIMER_REAL, self._seconds, _AGAIN)
        try:
            return ask(*arguments)
        finally:
            self._asked = False
            signal.setitimer(signal.ITIMER_REAL, 0.0)

    def _expired(self, _signal: int, _frame: FrameType | None) -> None:
        if self._asked:  # else it came back in the very last moment
            self._late = time.monotonic()
            raise self._too_late()

    def _too_late(self) -> TimeoutError:
        return TimeoutError(
            f"it took longer than {self._seconds:g} s for one decision, and is not asked again "
            f"for {self._pause:g} s"
        )


class GuardedScoring:
    """A scoring policy with a deadline."""

    def __init__(self, policy: ScoringPolicy, deadline: Deadline) -> None:
        self._policy, self._deadline = policy, deadline

    def score(self, hosts: HostView, process: ProcessView) -> Scores:
        """As the guarded policy."""
        return self._deadline.call(self._policy.score, hosts, process)


class _GuardedCheckpoints:
    """A checkpoint policy with a deadline."""

    def __init__(self, policy: CheckpointPolicy, deadline: Deadline) -> None:
        self._policy, self._deadline = policy, deadline

    def choose(self, process: CheckpointView) -> CheckpointChoice | None:
        """As the guarded policy."""
        return self._deadline.call(self._policy.choose, process)


class _GuardedPacing(_GuardedCheckpoints):
    """One that has memory dumped, too."""

    def __init__(self, policy: CheckpointPolicy, pacing: MemoryPacing, deadline: Deadline) -> None:
        super().__init__(policy, deadline)
        self._pacing = pacing

    def pace(self, process: MemoryView) -> float | None:
        """As the guarded policy."""
        return self._deadline.call(self._pacing.pace, process)


def guarded_checkpoints(policy: CheckpointPolicy, deadline: Deadline) -> CheckpointPolicy:
    """A checkpoint policy that does what the given one does, with a deadline for each call."""
    if isinstance(policy, MemoryPacing):
        return _GuardedPacing(policy, policy, deadline)
    return _GuardedCheckpoints(policy, deadline)
