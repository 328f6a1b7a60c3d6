"""Hears what a SLAM publishes, from outside: every pose, and when it came."""

from __future__ import annotations

import os
import threading
from dataclasses import dataclass
from typing import Any, Final

import rclpy
from nav_msgs.msg import Odometry
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions

from rosrm import RosSettings
from rosrm_examples.clouds import SCANS_QOS
from rosrm_examples.odometry import pose_of
from rosrm_examples.poses import Pose
from rosrm_examples.stamps import nanoseconds_of

_LOOK_S: Final = 0.1


@dataclass(frozen=True)
class Heard:
    """One pose that was published.

    Attributes:
        arrived: When DDS received it, unix seconds.
        stamp: Of the scan that it is the pose of, nanoseconds.
        pose: (4, 4).
    """

    arrived: float
    stamp: int
    pose: Pose


class Observer:
    """Keeps every message on `odometry`, until it is closed.

    DDS notes the time at which a message comes, in a thread of its own: it does not matter what
    this process is doing at that moment.

    Attributes:
        heard: In the order in which they came.
    """

    def __init__(self, ros: RosSettings) -> None:
        """Begins to listen."""
        os.environ.update(ros.environment())
        self.heard: list[Heard] = []
        self._context = rclpy.Context()
        rclpy.init(
            context=self._context,
            domain_id=ros.domain,
            signal_handler_options=SignalHandlerOptions.NO,
        )
        node = Node(
            "observer", context=self._context, use_global_arguments=False, enable_rosout=False,
            start_parameter_services=False,
        )  # fmt: skip
        self._input = node.create_subscription(Odometry, "odometry", self._take, SCANS_QOS)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(node)
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._listen, name="observer")
        self._thread.start()

    def publishers(self) -> int:
        """How many publishers of `odometry` are matched."""
        return int(self._input.get_publisher_count())

    def _listen(self) -> None:
        while not self._stopping.is_set():
            self._executor.spin_once(timeout_sec=_LOOK_S)

    def _take(self, message: Odometry, information: dict[str, Any]) -> None:
        arrived = information["received_timestamp"] / 1e9
        stamp = nanoseconds_of(message.header.stamp)
        self.heard.append(Heard(arrived, stamp, pose_of(message)))

    def close(self) -> None:
        """Listen no more."""
        self._stopping.set()
        self._thread.join()
        self._executor.shutdown()
        self._context.shutdown()
