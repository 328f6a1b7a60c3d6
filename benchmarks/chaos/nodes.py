"""ROS nodes of the workload; they write lines in the format of `plain`.

`speaker`: stateless. `counter`: counts its cycles, and keeps the count when it migrates.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence

import rclpy
import rclpy.node
from rclpy.clock import Clock, ClockType
from rclpy.executors import ExternalShutdownException
from rclpy.utilities import remove_ros_args
from std_msgs.msg import Int64

from benchmarks.chaos.plain import RATE, Lines
from rosrm.node import Node

#: By default, a timer of rclpy follows the wall clock, and waits where that is set back.
STEADY = Clock(clock_type=ClockType.STEADY_TIME)


class Speaker(rclpy.node.Node):  # type: ignore[misc]  # rclpy brings no types
    """A stateless node: `count` begins at 0 in each instance."""

    def __init__(self, lines: Lines) -> None:
        super().__init__("speaker")
        self._lines = lines
        self.count = 0
        self.output = self.create_publisher(Int64, "~/count", 10)
        self.create_timer(1.0 / RATE, self.tick, clock=STEADY)

    def tick(self) -> None:
        self.count += 1
        self.output.publish(Int64(data=self.count))
        self._lines.write("active", self.count)


class Counter(Node):
    """A stateful node: `count` continues in each successor, and no number is written twice."""

    def __init__(self, lines: Lines) -> None:
        super().__init__("counter")
        self._lines = lines
        self.count = 0
        self.output = self.create_publisher(Int64, "~/count", 10)
        self.create_timer(1.0 / RATE, self.tick, clock=STEADY)
        self.keep_state("~/state", Int64, self.save, self.restore)

    def tick(self) -> None:
        self.count += 1
        self.output.publish(Int64(data=self.count))
        self._lines.write("active", self.count)

    def save(self) -> Int64:
        return Int64(data=self.count)

    def restore(self, state: Int64) -> None:
        self.count = state.data
        self._lines.write("restored", self.count)  # in a standby, after each cycle of its primary


def main(arguments: Sequence[str]) -> None:
    kind = remove_ros_args(list(arguments))[1]
    lines = Lines()
    rclpy.init(args=list(arguments))
    try:
        rclpy.spin(Counter(lines) if kind == "counter" else Speaker(lines))
    except (KeyboardInterrupt, ExternalShutdownException):
        rclpy.try_shutdown()
    lines.write("stopped")


if __name__ == "__main__":
    main(sys.argv)
