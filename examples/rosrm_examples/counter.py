"""A counter that can be moved from host to host and never loses count."""

import rclpy
from rclpy.executors import ExternalShutdownException
from std_msgs.msg import Int64

from rosrm.node import Node


class Counter(Node):
    """Publishes 1, 2, 3, ... on `count`, ten times a second."""

    def __init__(self) -> None:
        """Begins at 0; a successor is given the state of the node before it."""
        super().__init__("counter")
        self.count = 0
        self.output = self.create_publisher(Int64, "count", 10)
        self.create_timer(0.1, self.tick)
        self.keep_state("~/state", Int64, self.save, self.restore)

    def tick(self) -> None:
        """Counts on."""
        self.count += 1
        self.output.publish(Int64(data=self.count))

    def save(self) -> Int64:
        """Returns all that a successor needs."""
        return Int64(data=self.count)

    def restore(self, state: Int64) -> None:
        """Takes it over."""
        self.count = state.data


if __name__ == "__main__":
    rclpy.init()
    try:
        rclpy.spin(Counter())
    except (KeyboardInterrupt, ExternalShutdownException):
        rclpy.try_shutdown()
