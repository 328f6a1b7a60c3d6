"""Components for tests of `rosrm container`."""

from __future__ import annotations

import gc
import time
from typing import Any

from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.node import Node
from std_msgs.msg import String

from tests.ros.nodes import Counter


class Talker(Node):
    """Publishes its parameter `says` at 20 Hz."""

    def __init__(self, **options: Any) -> None:
        super().__init__("talker", **options)
        says = self.declare_parameter("says", "nothing")
        output = self.create_publisher(String, "words", 10)
        self.get_logger().info(f"{self.get_fully_qualified_name()} says {says.value}")
        self.create_timer(0.05, lambda: output.publish(String(data=says.value)))


class Broken(Node):
    """Cannot be made."""

    def __init__(self, **options: Any) -> None:
        super().__init__("broken", **options)
        self.destroy_node()
        raise OSError("no device here")


class Half(Node):
    """Has a timer, which refers to the node, when its constructor raises.

    Python collects unused nodes at any time; from now on only if the container asks for it.
    """

    def __init__(self, **options: Any) -> None:
        super().__init__("half", **options)
        self.create_timer(1.0, self.tick)
        gc.disable()
        raise OSError("no device here")

    def tick(self) -> None: ...


class Plain:
    """A class that is no node."""

    def __init__(self, **options: Any) -> None: ...


class Shy(Counter):
    """A counter that cannot be made as the destination of a move."""

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        if self._rosrm.identity.shadow:
            raise OSError("no device there")


class Stuck(Node):
    """A node with a callback that never ends."""

    def __init__(self, **options: Any) -> None:
        super().__init__("stuck", **options)
        self.create_timer(0.1, self.sleep)

    def sleep(self) -> None:
        self.get_logger().info("is stuck")
        while True:
            time.sleep(1.0)


class Managed(LifecycleNode):
    """A lifecycle node that prints its name when it is activated."""

    def __init__(self, **options: Any) -> None:
        super().__init__("managed", **options)

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        self.get_logger().info(f"{self.get_fully_qualified_name()} is activated")
        return super().on_activate(state)
