"""Nodes that `benchmarks.handoff` migrates, and the driver that publishes their inputs.

Each output is [instance, sequence, input]: the publishing instance, the number of outputs up to
this one, and the number of the input that it answers. An answer also has the time at which its
input was sent (unix time in ns).
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections.abc import Sequence
from typing import Any

import rclpy
import rclpy.node
from rclpy.executors import ExternalShutdownException
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.utilities import remove_ros_args
from std_msgs.msg import Int64, Int64MultiArray

from rosrm.node import Node

QOS = QoSProfile(depth=2000, reliability=ReliabilityPolicy.RELIABLE)
INPUT = "handoff_input"
OUTPUT = "handoff_output"
#: Seconds for which the driver waits for the first subscriber.
_MATCH = 30.0


def instance() -> int:
    """Return the number of this instance, set by its slave; 0: not started by rosrm."""
    return int(os.environ.get("ROSRM_INSTANCE", "#0").rpartition("#")[2])


class Echo(Node):
    """A stateful node that answers each input with a number that grows by one."""

    def __init__(self) -> None:
        super().__init__("echo")
        self.sequence = 0
        self.output = self.create_publisher(Int64MultiArray, OUTPUT, QOS)
        self.create_subscription(Int64, INPUT, self.answer, QOS)
        self.keep_state("~/state", Int64, self.save, self.restore)

    def answer(self, message: Int64, info: Any) -> None:
        self.sequence += 1
        answer = [instance(), self.sequence, message.data, info["source_timestamp"]]
        self.output.publish(Int64MultiArray(data=answer))

    def save(self) -> Int64:
        return Int64(data=self.sequence)

    def restore(self, state: Int64) -> None:
        self.sequence = state.data


class Count(Node):
    """A stateful node that counts by a timer of its own.

    A cycle publishes the output first, and then the state, [instance, sequence], for an observer of
    both.
    """

    def __init__(self, rate: float) -> None:
        super().__init__("count")
        self.sequence = 0
        self.output = self.create_publisher(Int64MultiArray, OUTPUT, QOS)
        self.create_timer(1.0 / rate, self.tick)
        self.keep_state("~/state", Int64MultiArray, self.save, self.restore)

    def tick(self) -> None:
        self.sequence += 1
        self.output.publish(Int64MultiArray(data=[instance(), self.sequence, self.sequence]))

    def save(self) -> Int64MultiArray:
        return Int64MultiArray(data=[instance(), self.sequence])

    def restore(self, state: Int64MultiArray) -> None:
        self.sequence = state.data[-1]


class Tick(rclpy.node.Node):  # type: ignore[misc]  # rclpy brings no types
    """A stateless node with the same output in each cycle."""

    def __init__(self, rate: float) -> None:
        super().__init__("tick")
        self.output = self.create_publisher(Int64MultiArray, OUTPUT, QOS)
        self.create_timer(1.0 / rate, self.tick)

    def tick(self) -> None:
        self.output.publish(Int64MultiArray(data=[instance(), 0, 0]))


def drive(rate: float) -> None:
    """Publish 1, 2, 3, ... at a rate, from the first subscriber on, until the process stops."""
    node = rclpy.node.Node("handoff_driver")
    inputs = node.create_publisher(Int64, INPUT, QOS)
    deadline = time.monotonic() + _MATCH
    while not inputs.get_subscription_count():
        if time.monotonic() >= deadline:
            raise TimeoutError(f"{INPUT} had no subscriber within {_MATCH:g} s")
        rclpy.spin_once(node, timeout_sec=0.05)
    begun, sent = time.monotonic(), 0
    while rclpy.ok():
        sent += 1
        time.sleep(max(0.0, begun + sent / rate - time.monotonic()))
        inputs.publish(Int64(data=sent))


def node_of(program: str, rate: float) -> rclpy.node.Node:
    if program == "echo":
        return Echo()
    return Count(rate) if program == "count" else Tick(rate)


def main(arguments: Sequence[str]) -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("program", choices=["echo", "count", "tick", "drive"])
    parser.add_argument("--rate", type=float, default=10.0)
    chosen = parser.parse_args(remove_ros_args(list(arguments))[1:])
    rclpy.init(args=list(arguments))
    try:
        if chosen.program == "drive":
            drive(chosen.rate)
        else:
            rclpy.spin(node_of(chosen.program, chosen.rate))
    except (KeyboardInterrupt, ExternalShutdownException):
        rclpy.try_shutdown()


if __name__ == "__main__":
    main(sys.argv)
