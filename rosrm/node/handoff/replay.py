"""Replay of buffered messages in an active node, in slices, so that its timers keep running."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from typing import Any, Final

from rosrm.node.steady_timer import steady_timer

#: Seconds of one slice; a callback that has begun is finished.
_SLICE: Final = 0.02
#: Marks the end of the steps.
_END: Final = object()


class InputReplay:
    """Replay in the executor, so that a callback's exception reaches the author.

    Args:
        plain: gives access to rclpy's own methods of the node.
        turn: lock that is held while a callback runs.
        serve_next: serves the oldest buffered message; returns False if none is left.
    """

    def __init__(self, plain: Any, turn: Any, serve_next: Callable[[], bool]) -> None:
        self._plain = plain
        self._turn = turn
        self._serve_next = serve_next
        self._timer: Any = None
        self._beside: Iterator[None] = iter(())
        self._then: Callable[[], None] = lambda: None
        self._counted = 0

    @property
    def is_on(self) -> bool:
        """Return True while buffered messages may be left; new messages then queue behind them."""
        return self._timer is not None

    def begin(self, beside: Iterator[None]) -> None:
        """Serve all buffered messages, in slices, from the executor's next round on.

        After each slice the generator `beside` (further work) is advanced by one step.
        """
        self._beside = beside
        self._start()

    def serve(self, count: int, then: Callable[[], None]) -> None:
        """Serve `count` messages, then call `then`; serve the remaining and new ones after that."""
        self._counted, self._then = count, then
        self._start()

    def _start(self) -> None:
        if self._timer is None:
            self._timer = steady_timer(self._plain, 0.0, self._serve_slice)

    def _serve_slice(self) -> None:
        with self._turn:
            if self._timer is None:
                return
            try:
                more = self._serve_until(time.monotonic() + _SLICE)
            finally:
                steps = next(self._beside, _END) is not _END
            if not more or self._counted <= 0:
                then, self._then = self._then, lambda: None
                then()
            if not (more or steps):
                self._plain.destroy_timer(self._timer)
                self._timer = None

    def _serve_until(self, end: float) -> bool:
        """Serve messages until `end`; return True if more may be left."""
        while self._serve_next():
            self._counted -= 1
            if self._counted == 0 or time.monotonic() >= end:
                return True
        return False
