"""Timers by the monotonic clock, independent of clock changes and simulated time."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rclpy.clock import Clock
from rclpy.clock_type import ClockType


def steady_timer(
    plain: Any, period: float, callback: Callable[[], None], *, autostart: bool = True
) -> Any:
    """Create a timer by the monotonic clock; rclpy's default follows the node's (wall) clock.

    Without `autostart` the timer starts at its `reset`. `plain` gives access to rclpy's own methods
    of the node.
    """
    clock = Clock(clock_type=ClockType.STEADY_TIME)
    return plain.create_timer(period, callback, clock=clock, autostart=autostart)
