"""Replay of buffered messages in an active node, in slices, so that its timers keep running."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final

from rosrm import clocks
from rosrm.node.steady_timer import steady_timer

#: Seconds of one slice; a callback that has begun is finished.
_SLICE: Final = 0.02
#: Seconds without a cycle after which a node counts as idle.
_IDLE: Final = 0.02
#: Seconds after which the further work no longer waits for cycles.
_MOST_SPREAD: Final = 0.1


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
        self._pause: Any = None
        self._is_idle = False
        self._spread_until = 0.0
        self._beside: Callable[[], bool] = lambda: False
        self._then: Callable[[], None] = lambda: None
        self._counted = 0

    @property
    def is_on(self) -> bool:
        """Return True while buffered messages may be left; new messages then queue behind them."""
        return self._timer is not None

    def begin(self, beside: Callable[[], bool]) -> None:
        """Serve all buffered messages, in slices, from the executor's next round on.

        `beside` does one step of further work, and returns False if there is none. It is called
        after each slice, then after each cycle, and without a pause once the node is idle. A step
        takes some ms; just before the next message it would delay that message.
        """
        self._beside, self._is_idle = beside, False
        self._spread_until = clocks.boot_time() + _MOST_SPREAD
        self._end_pause()
        self._pause = steady_timer(self._plain, _IDLE, self._become_idle)
        self._start()

    def after_cycle(self) -> None:
        """Advance the further work by one step, unless a slice does so."""
        if self._pause is None or self._timer is not None or not self._advance():
            return
        if clocks.boot_time() < self._spread_until:
            self._pause.reset()

    def _become_idle(self) -> None:
        with self._turn:
            self._end_pause()
            self._is_idle = True
            self._start()

    def _advance(self) -> bool:
        """Do one step of the further work; return False after the last one."""
        if self._beside():
            return True
        self._end_pause()
        return False

    def _end_pause(self) -> None:
        if self._pause is not None:
            self._plain.destroy_timer(self._pause)
            self._pause = None

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
                more = self._serve_until(clocks.boot_time() + _SLICE)
            finally:
                steps = self._advance()
            if not more or self._counted <= 0:
                then, self._then = self._then, lambda: None
                then()
            if not (more or (steps and self._is_idle)):
                self._plain.destroy_timer(self._timer)
                self._timer = None

    def _serve_until(self, end: float) -> bool:
        """Serve messages until `end`; return True if more may be left."""
        while self._serve_next():
            self._counted -= 1
            if self._counted == 0 or clocks.boot_time() >= end:
                return True
        return False
