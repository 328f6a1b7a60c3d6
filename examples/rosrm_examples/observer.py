"""Observer of a SLAM from outside: every pose, with its time of arrival."""

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
class ReceivedPose:
    """One pose that was published.

    Attributes:
        arrived: When DDS received it, unix time in seconds.
        stamp: Of its scan, nanoseconds.
        pose: (4, 4).
    """

    arrived: float
    stamp: int
    pose: Pose


class Observer:
    """A recorder of every message on `odometry`, until it is closed.

    DDS notes the time of arrival in a thread of its own, so a busy process does not distort it.

    Attributes:
        received: In order of arrival.
    """

    def __init__(self, ros: RosSettings) -> None:
        """Subscribe."""
        os.environ.update(ros.environment())
        self.received: list[ReceivedPose] = []
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
        """Return the number of matched publishers of `odometry`."""
        return int(self._input.get_publisher_count())

    def _listen(self) -> None:
        while not self._stopping.is_set():
            self._executor.spin_once(timeout_sec=_LOOK_S)

    def _take(self, message: Odometry, information: dict[str, Any]) -> None:
        arrived = information["received_timestamp"] / 1e9
        stamp = nanoseconds_of(message.header.stamp)
        self.received.append(ReceivedPose(arrived, stamp, pose_of(message)))

    def close(self) -> None:
        """Unsubscribe, and end the thread."""
        self._stopping.set()
        self._thread.join()
        self._executor.shutdown()
        self._context.shutdown()
