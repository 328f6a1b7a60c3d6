"""Links between real slaves, and flows between real nodes, on one machine."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from rosrm.config.settings import LinkSettings, NetworkSettings, ScoringChoice
from rosrm.testing.local_cluster import LocalCluster
from tests.ros.clusters import MIB, STEADY, host, service
from tests.waiting import wait_until

MB = 1e6


def flow_of(cluster: LocalCluster, name: str) -> Mapping[str, Any]:
    (flow,) = cluster.client.explain(name)["flows"]
    return flow


def test_links_are_measured_and_their_limits_hold(make_cluster) -> None:
    """The sealed measurement reaches the master, and decides with the sentence in `explain`."""
    cluster = make_cluster(
        host("robot-1", labels={"at": "robot"}, links=LinkSettings(rate=5 * MB)),
        host("base", labels={"at": "base"}), liveness=STEADY,
        network=NetworkSettings(period=0.5), scoring=ScoringChoice("network"),
    )  # fmt: skip
    small = {"needs": {"memory": MIB}}
    cluster.submit(
        service("camera", required_labels={"at": "robot"}, **small),
        service("viewer", required_labels={"at": "base"}, talks_to={"camera": 1 * MB}, **small),
    )
    cluster.wait("viewer", "running")
    cluster.wait("camera", "running")
    flow = wait_until(
        lambda: (
            found if (found := flow_of(cluster, "viewer"))["round_trip"] is not None else None
        ),
        "a measured round trip", seen=lambda: flow_of(cluster, "viewer"), pause=cluster.client.spin,
    )  # fmt: skip
    assert 0.0 < flow["round_trip"] < 1.0
    assert flow["link_rate"] == 5 * MB

    cluster.submit(service("detector", talks_to={"camera": 20 * MB}, **small))
    assert cluster.wait("detector", "running").host == "robot-1"
    decision = cluster.client.explain("detector")["decision"]
    assert decision["policy"] == "network"
    (why,) = (one["reason"] for one in decision["hosts"] if one["name"] == "base")
    assert why.startswith("20 MB/s from camera on robot-1 would cross a 5 MB/s link")
