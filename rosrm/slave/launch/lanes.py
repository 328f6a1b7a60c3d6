"""Threads for calls that may hang: the calls of one lane run one after the other."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Any

from rosrm import threads
from rosrm.extensions.time_limit import interrupt_thread

#: Takes the outcome of a call: its result, or the exception that it raised.
Done = Callable[[Any], None]


@dataclass(slots=True, eq=False)
class _Call:
    work: Callable[[], Any]
    done: Done
    thread: int = 0
    settled: bool = False
    timer: threading.Timer | None = field(default=None)


class Lanes:
    """Threads of calls that may hang; only the loop uses this object.

    A call that hangs delays its own lane by `limit` seconds, and no other lane.

    Args:
        post: schedules a call in the loop; may be called from any thread.
        limit: seconds of one call; a late one counts as failed with `TimeoutError`.
    """

    def __init__(self, post: Callable[[Callable[[], None]], None], limit: float) -> None:
        self._post, self._limit = post, limit
        self._lanes: dict[str, deque[_Call]] = {}

    def run(self, lane: str, work: Callable[[], Any], done: Done) -> None:
        """Call `work` in a thread, after the earlier calls of the lane, then `done` in the loop."""
        calls = self._lanes.setdefault(lane, deque())
        calls.append(_Call(work, done))
        if len(calls) == 1:
            self._begin(lane, calls[0])

    def _begin(self, lane: str, call: _Call) -> None:
        late = TimeoutError(f"it took longer than {self._limit:g} s")
        settle = partial(self._settle, lane, call)
        call.timer = threading.Timer(self._limit, self._post, [partial(settle, late)])
        call.timer.daemon = True

        def work() -> None:
            call.thread = threading.get_ident()
            try:
                outcome = call.work()
            except BaseException as fault:  # noqa: BLE001 - the loop handles it
                outcome = fault
            call.thread = 0
            self._post(partial(settle, outcome))

        try:
            call.timer.start()
            threads.start(work, f"start {lane}")
        except RuntimeError as fault:  # no further thread: the limit of the user or the group
            self._post(partial(settle, fault))

    def _settle(self, lane: str, call: _Call, outcome: Any) -> None:
        if call.settled:
            return
        call.settled = True
        if call.timer is not None:
            call.timer.cancel()
            call.timer = None  # it refers to the call; only a collection of garbage frees a cycle
        if call.thread:  # late
            interrupt_thread(call.thread)
        calls = self._lanes[lane]
        calls.popleft()
        if calls:
            self._begin(lane, calls[0])
        else:
            del self._lanes[lane]
        call.done(outcome)
