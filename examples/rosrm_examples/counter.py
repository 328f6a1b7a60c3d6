"""A counter that migrates from host to host and never loses count."""

import rclpy
from rclpy.executors import ExternalShutdownException
from std_msgs.msg import Int64

from rosrm.node import Node


class Counter(Node):
    """A node that publishes 1, 2, 3, ... on `count`, ten times a second."""

    def __init__(self) -> None:
        """Begin at 0; a successor restores the state of the node before it."""
        super().__init__("counter")
        self.count = 0
        self.output = self.create_publisher(Int64, "count", 10)
        self.create_timer(0.1, self.tick)
        self.keep_state("~/state", Int64, self.save, self.restore)

    def tick(self) -> None:
        """Increment the count, and publish it."""
        self.count += 1
        self.output.publish(Int64(data=self.count))

    def save(self) -> Int64:
        """Return the state that a successor needs."""
        return Int64(data=self.count)

    def restore(self, state: Int64) -> None:
        """Restore the state of the predecessor."""
        self.count = state.data


if __name__ == "__main__":
    rclpy.init()
    try:
        rclpy.spin(Counter())
    except (KeyboardInterrupt, ExternalShutdownException):
        rclpy.try_shutdown()
