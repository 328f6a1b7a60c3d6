"""A node of rclpy's is dumped and restored on its host, and those who listen hear it go on."""

from __future__ import annotations

import os
import sys

import pytest
from std_msgs.msg import Int64

from tests.ros.nodes import RELIABLE

pytestmark = pytest.mark.timeout(240)

#: Publishes one number after the other.
NODE = """
import rclpy
from rclpy.qos import QoSProfile, ReliabilityPolicy
from std_msgs.msg import Int64
rclpy.init()
node = rclpy.create_node("counter")
qos = QoSProfile(depth=1000, reliability=ReliabilityPolicy.RELIABLE)
output, count = node.create_publisher(Int64, "count", qos), 0
def tick():
    global count
    count += 1
    output.publish(Int64(data=count))
timer = node.create_timer(0.02, tick)
rclpy.spin(node)
"""


def test_a_subscriber_hears_a_restored_node_go_on(theatre, stage, private_network):
    """Twice in a row, with nothing lost or repeated: the participant is the same all along."""
    if os.environ.get("FASTDDS_BUILTIN_TRANSPORTS") != "UDPv4":
        pytest.skip("a network of its own, with UDPv4 alone, may not be made here")
    heard = stage.listen(Int64, "/count", RELIABLE)
    environment = {**os.environ, "ROS_DOMAIN_ID": str(stage.domain)}
    actor = theatre.run([sys.executable, "-c", NODE], environment=environment)
    stage.spin_until(lambda: len(heard) > 10, "numbers of the node")
    for hop in range(2):
        directory = theatre.dump(actor, f"hop{hop}")
        actor = theatre.restore(directory, remove=True)
        seen = len(heard)
        stage.spin_until(lambda: len(heard) > seen + 20, "numbers of the restored node")  # noqa: B023
    numbers = [message.data for message in heard]
    assert numbers == list(range(numbers[0], numbers[-1] + 1))
