"""Links between real slaves, and flows between real nodes, on one machine."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from rosrm.config.settings import LinkSettings, NetworkSettings, ScoringChoice
from rosrm.testing.local_cluster import LocalCluster
from tests.ros.clusters import MIB, SPIN, STEADY, host, node, service
from tests.waiting import PATIENCE, wait_until

MB = 1e6


def flow_of(cluster: LocalCluster, name: str) -> Mapping[str, Any]:
    (flow,) = cluster.client.explain(name)["flows"]
    return flow


def test_links_are_measured_and_their_limits_hold(make_cluster) -> None:
    """The sealed measurement reaches the master, and decides with the sentence in `explain`."""
    cluster = make_cluster(
        host("robot-1", labels={"at": "robot"}, links=LinkSettings(rate=5 * MB)),
        host("base", labels={"at": "base"}), liveness=STEADY,
        network=NetworkSettings(period=0.5), scoring=(ScoringChoice("network"),),
    )  # fmt: skip
    small = {"needs": {"memory": MIB}}
    cluster.submit(
        service("camera", required_labels={"at": "robot"}, **small),
        service("viewer", required_labels={"at": "base"}, talks_to={"camera": 1 * MB}, **small),
    )
    cluster.wait("viewer", "running")
    cluster.wait("camera", "running")

    def measured() -> Mapping[str, Any] | None:
        found = flow_of(cluster, "viewer")
        return None if None in (found["round_trip"], found["link_rate"]) else found

    flow = wait_until(
        measured, "round trip and rate of the link", seen=lambda: flow_of(cluster, "viewer"),
        pause=cluster.client.spin,
    )  # fmt: skip
    assert 0.0 < flow["round_trip"] < 1.0
    assert flow["link_rate"] == 5 * MB

    cluster.submit(service("detector", talks_to={"camera": 20 * MB}, **small))
    assert cluster.wait("detector", "running").host == "robot-1"
    decision = cluster.client.explain("detector")["decision"]
    assert decision["policy"] == "network"
    (why,) = (one["reason"] for one in decision["hosts"] if one["name"] == "base")
    assert why.startswith("20 MB/s from camera on robot-1 would cross a 5 MB/s link")


#: Publishes 20 messages of 50 kB a second.
CAMERA = (
    """
import rclpy
from rclpy.node import Node
from std_msgs.msg import String
rclpy.init()
node = Node("camera")
out = node.create_publisher(String, "image", 5)
image = String(data="x" * 50_000)
node.create_timer(0.05, lambda: out.publish(image))
"""
    + SPIN
)
VIEWER = (
    """
import rclpy
from rclpy.node import Node
from std_msgs.msg import String
rclpy.init()
node = Node("viewer")
node.create_subscription(String, "image", lambda _: None, 5)
"""
    + SPIN
)


def test_the_rate_of_a_topic_is_learned_as_a_flow_between_its_processes(make_cluster) -> None:
    """The slave of the subscriber samples it, and the master knows both processes."""
    cluster = make_cluster(
        host("a", labels={"at": "a"}), host("b", labels={"at": "b"}), liveness=STEADY,
        network=NetworkSettings(period=0.5),
    )  # fmt: skip
    cluster.submit(
        node("camera", CAMERA, required_labels={"at": "a"}),
        node("viewer", VIEWER, required_labels={"at": "b"}),
    )
    cluster.wait("viewer", "running")

    def learned() -> Mapping[str, Any] | None:
        found = [one for one in cluster.client.explain("viewer")["flows"] if one["rate"]]
        return found[0] if found else None

    flow = wait_until(learned, "a learned flow", 2 * PATIENCE, pause=cluster.client.spin)
    assert (flow["process"], flow["host"], flow["learned"]) == ("camera", "a", True)
    assert 0.3 * MB < flow["rate"] < 3 * MB
