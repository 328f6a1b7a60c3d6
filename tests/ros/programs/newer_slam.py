"""A newer version of the SLAM node, as another program: it publishes the speed, too.

    python newer_slam.py [--forgetful] --ros-args -p out:=/tmp/parts

With --forgetful it cannot restore the state of the former version.
"""

from __future__ import annotations

import sys
from typing import Any

import numpy as np
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import Float64

from rosrm_examples import slam_node


class NewerSlam(slam_node.SlamNode):
    """A SLAM that publishes its speed on `speed`, metres a second, once for each scan."""

    def __init__(self) -> None:
        super().__init__()
        self._speed = self.create_publisher(Float64, "speed", 10)

    def take_scan(self, message: PointCloud2) -> None:
        """Map a scan, and publish pose and speed."""
        super().take_scan(message)
        self._speed.publish(Float64(data=float(np.linalg.norm(self.live.slam.velocity[:3]))))


class ForgetfulSlam(NewerSlam):
    """A SLAM that expects a state of another form."""

    def keep_state(self, topic: str, message_type: type, save: Any, _restore: Any) -> None:
        """Keep the state, but refuse that of the former version."""
        super().keep_state(topic, message_type, save, self.refuse)

    def refuse(self, _state: Any) -> None:
        """Raise, as a program does that finds other arrays than it expects."""
        raise KeyError("velocity_of_sensor")


if __name__ == "__main__":
    forgets = "--forgetful" in sys.argv
    sys.exit(slam_node.main(make_node=ForgetfulSlam if forgets else NewerSlam))
