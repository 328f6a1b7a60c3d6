"""Start order on a real slave: a job, two services, and their stops in the reverse order."""

from __future__ import annotations

import pytest

from rosrm.errors import Refused
from rosrm.model.values import StartOrder
from tests.ros.clusters import host, job, node, service


def test_processes_start_in_their_order_and_stop_in_the_reverse_one(make_cluster, tmp_path) -> None:
    """A node starts when a job has finished, a service when the node is in the ROS graph."""
    cluster = make_cluster(host("a"))
    gate = tmp_path / "gate"
    viewer = service("viewer", start_order=StartOrder({"camera": "ready"}))
    camera = node("camera", start_order=StartOrder({"calibrate": "finished"}))
    with pytest.raises(Refused, match="viewer: after: no such process: 'camera'"):
        cluster.submit(viewer)
    wait = f"until [ -e {gate} ]; do sleep 0.05; done"
    cluster.submit(viewer, camera, job("calibrate", "sh", "-c", wait))
    cluster.wait("calibrate", "running")
    reason = "waits for calibrate to finish"
    assert cluster.wait("camera", "queued", reason=reason).host == ""
    assert cluster.process("viewer").reason == "waits for camera to be ready"

    gate.touch()
    cluster.wait("viewer", "running")
    cluster.cancel("camera", "viewer")

    sequence = {(one.process, one.kind): one.sequence for one in cluster.events()}
    assert sequence["calibrate", "finished"] < sequence["camera", "assigned"]
    assert sequence["camera", "ready"] < sequence["viewer", "assigned"]
    assert sequence["viewer", "cancelled"] < sequence["camera", "cancelled"]
    assert cluster.events("dependants_left") == []
