"""Timers by the monotonic clock, which no clock change or simulation delays."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rclpy.clock import Clock
from rclpy.clock_type import ClockType


def steady_timer(
    plain: Any, period: float, callback: Callable[[], None], *, autostart: bool = True
) -> Any:
    """Create a timer by the monotonic clock; rclpy's default follows the node's (wall) clock.

    Args:
        plain: rclpy's own methods of a node.
        period: seconds.
        callback: called at each period.
        autostart: True: the timer runs from now on; False: from its `reset`.
    """
    clock = Clock(clock_type=ClockType.STEADY_TIME)
    return plain.create_timer(period, callback, clock=clock, autostart=autostart)
