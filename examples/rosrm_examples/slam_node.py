"""A ROS 2 node that maps a drive live, and that rosrm can migrate to another host.

    python -m rosrm_examples.slam_node --ros-args -p state:=pose -p out:=/tmp/parts

| topic      | type                    |                                                    |
|------------|-------------------------|----------------------------------------------------|
| `points`   | sensor_msgs/PointCloud2 | in: a scan, in the sensor's frame                  |
| `odometry` | nav_msgs/Odometry       | out: pose and velocity, once for each scan         |
| `map`      | sensor_msgs/PointCloud2 | out, latched: the map, every `map_every` keyframes |

Parameters: `state`, "full" or "pose": the state that a successor restores, see slam_state.py;
`map_every`, keyframes; `out`, a folder in which the node writes its own part of the map when SIGINT
or SIGTERM ends it.
"""

from __future__ import annotations

import os
import signal

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before numpy: a process should use one core
if __name__ == "__main__":
    signal.signal(signal.SIGINT, signal.SIG_DFL)  # no traceback while the imports below run

import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Final

from nav_msgs.msg import Odometry
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import PointCloud2

from rosrm.node import Node
from rosrm_examples.clouds import SCANS_QOS, cloud_message, points_of
from rosrm_examples.errors import ExampleError
from rosrm_examples.lean_node import ros_context
from rosrm_examples.live_slam import LiveSlam
from rosrm_examples.map_part import save_part
from rosrm_examples.odometry import MAP_FRAME, odometry_message
from rosrm_examples.slam_state import STATES, StateTopic
from rosrm_examples.stamps import seconds_of
from rosrm_examples.stopping import StopSignals

_LATCHED: Final = QoSProfile(
    depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL
)
_LOOK_S: Final = 0.1


class SlamNode(Node):
    """A node that maps the scans on `points`.

    Attributes:
        live: the mapping.
    """

    def __init__(self) -> None:
        super().__init__("slam")
        self.live = LiveSlam()
        self._map_every = int(self.declare_parameter("map_every", 10).value)
        self._out = str(self.declare_parameter("out", "").value)
        self._odometry = self.create_publisher(Odometry, "odometry", SCANS_QOS)
        self._map = self.create_publisher(PointCloud2, "map", _LATCHED)
        self.create_subscription(PointCloud2, "points", self.take_scan, SCANS_QOS)
        for topic in self._state():
            self.keep_state(topic.name, topic.type, topic.save, topic.restore)
        self.when_active(self.publish_map)  # late subscribers receive it also after a migration

    def _state(self) -> list[StateTopic]:
        state = str(self.declare_parameter("state", "full").value)
        if state not in STATES:
            raise ExampleError(f"parameter state: {state!r}; allowed are {', '.join(STATES)}")
        return STATES[state](self.live)

    def take_scan(self, message: PointCloud2) -> None:
        """Map a scan, and publish its pose."""
        slam = self.live.slam
        keyframes, t = slam.keyframes, seconds_of(message.header.stamp)
        try:
            self.live.add_scan(points_of(message), t)
        except ValueError as error:
            self.get_logger().warning(f"scan at {t} s left out: {error}")
            return
        self._odometry.publish(odometry_message(self.live.pose, slam.velocity, t))
        if slam.keyframes > keyframes and slam.keyframes % self._map_every == 0:
            self.publish_map()

    def publish_map(self) -> None:
        """Publish the map, if there is one yet."""
        if self.live.time is not None:
            points = self.live.slam.map_points()
            self._map.publish(cloud_message(points, self.live.time, MAP_FRAME))

    def write_part(self) -> Path | None:
        """Write the part that this instance mapped; None: there is none, or no folder for it."""
        part = self.live.part(os.environ.get("ROSRM_HOST", ""))
        if not self._out or not len(part.times):
            return None
        instance = os.environ.get("ROSRM_INSTANCE", "slam").replace("#", "_")
        path = Path(self._out) / f"{instance}.npz"
        save_part(path, part)
        return path


def main(
    arguments: Sequence[str] | None = None, make_node: Callable[[], SlamNode] = SlamNode
) -> int:
    """Map until SIGINT or SIGTERM; return the exit status."""
    raw = list(sys.argv if arguments is None else ["slam_node", *arguments])
    stop = StopSignals()
    try:
        with ros_context(raw):
            path = _map(make_node, stop)
    except (ExampleError, OSError) as error:
        print(f"slam_node: {error}", file=sys.stderr)
        return 2
    print("nothing written" if path is None else f"wrote {path}", flush=True)
    return 0


def _map(make_node: Callable[[], SlamNode], stop: StopSignals) -> Path | None:
    node = make_node()
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    while stop.came is None:
        executor.spin_once(timeout_sec=_LOOK_S)
    return node.write_part()


if __name__ == "__main__":
    sys.exit(main())
