"""Timers of our own: no clock that can be set, or that is simulated, holds them up."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rclpy.clock import Clock
from rclpy.clock_type import ClockType


def steady_timer(
    plain: Any, period: float, callback: Callable[[], None], *, autostart: bool = True
) -> Any:
    """A timer by the monotonic clock; rclpy's default goes by the node's, which follows the wall.

    Args:
        plain: rclpy's own methods of a node.
        period: seconds.
        callback: called at each period.
        autostart: it runs from now on; else from its `reset`.
    """
    clock = Clock(clock_type=ClockType.STEADY_TIME)
    return plain.create_timer(period, callback, clock=clock, autostart=autostart)
