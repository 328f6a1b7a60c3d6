"""A portable node that counts, and can do wrong in ways that its first argument names."""

from __future__ import annotations

import socket
import sys
import time

from rclpy.executors import MultiThreadedExecutor, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from std_msgs.msg import Int64
from std_srvs.srv import Trigger

from rosrm_criu.node import PortableNode, run_portable

RELIABLE = QoSProfile(depth=1000, reliability=ReliabilityPolicy.RELIABLE)
FAULT = sys.argv[1] if len(sys.argv) > 1 else ""


class Brain(PortableNode):
    """Counts by a timer, adds what comes on `add`, and answers on `total`."""

    def __init__(self) -> None:
        super().__init__("brain")
        self.declare_parameter("step", 1)
        self.count = 0
        self.total = 0
        self.joined = 0
        self.slow = 0
        if FAULT == "makes in constructor":
            self.create_publisher(Int64, "early", 10)

    def join(self) -> None:
        if FAULT == "join fails" and self.joined:
            raise ValueError("no camera here")
        self.joined += 1
        self.declare_parameter("limit", 10.0)
        self.output = self.create_publisher(Int64, "count", RELIABLE)
        self.sums = self.create_publisher(Int64, "sum", RELIABLE)
        self.create_subscription(Int64, "add", self.add, RELIABLE)
        self.create_service(Trigger, "total", self.say)
        self.create_timer(0.02, self.tick)
        self.create_timer(100.0, self.seldom)
        self.once = self.create_timer(0.01, self.at_once)
        if FAULT == "long callback":
            self.create_timer(0.01, self.sleep)

    def leave(self) -> None:
        if FAULT == "leave fails":
            raise ValueError("the arm is moving")
        if FAULT == "socket":
            self.socket = socket.create_server(("127.0.0.1", 0))
        if FAULT == "other node":
            self.other = Node("other")

    def tick(self) -> None:
        if FAULT == "exits" and self.count == 20:
            sys.exit(3)
        self.count += self.get_parameter("step").value
        self.output.publish(Int64(data=self.count))

    def add(self, message: Int64) -> None:
        self.total += message.data
        self.sums.publish(Int64(data=self.total))

    def say(self, _request, response):
        due = next(one for one in self.timers if one.timer_period_ns > 10**10)
        response.message = " ".join(
            str(one)
            for one in (
                self.joined, self.get_parameter("step").value, self.get_parameter("limit").value,
                round(due.time_until_next_call() / 1e9, 3), self.slow,
            )
        )  # fmt: skip
        return response

    def seldom(self) -> None:
        """Its period is longer than any test."""

    def at_once(self) -> None:
        self.once.cancel()
        self.slow += 1

    def sleep(self) -> None:
        """A cycle that must not be cut."""
        before = self.count
        time.sleep(0.3)
        self.count = before + 1
        self.output.publish(Int64(data=self.count))


if __name__ == "__main__":
    run_portable(
        Brain,
        executor=MultiThreadedExecutor if FAULT == "threads" else SingleThreadedExecutor,
        patience=20.0,  # peers are found late on a busy machine
    )
