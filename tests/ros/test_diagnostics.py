"""`/diagnostics` of a real master, as a subscriber without anything of rosrm receives it."""

from __future__ import annotations

import contextlib
import itertools
import signal
import time

import pytest
import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rclpy.executors import SingleThreadedExecutor

from rosrm.config.settings import LivenessSettings
from tests.ros.clusters import STEADY, host, python, service
from tests.waiting import PATIENCE, wait_until

#: Fails unless a file exists.
MOODY = """
import os, sys, time
os.path.exists({file!r}) or sys.exit(3)
time.sleep(999)
"""


class Monitor:
    """A subscriber with the QoS that ROS uses by default.

    Attributes:
        messages: received ones, oldest first.
    """

    def __init__(self, domain: int) -> None:
        self.messages: list[DiagnosticArray] = []
        self.context = rclpy.Context()
        rclpy.init(context=self.context, domain_id=domain)
        self.node = rclpy.create_node("monitor", context=self.context)
        self.node.create_subscription(DiagnosticArray, "/diagnostics", self.messages.append, 10)
        self.executor = SingleThreadedExecutor(context=self.context)
        self.executor.add_node(self.node)

    def spin(self, seconds: float) -> None:
        self.executor.spin_once(timeout_sec=seconds)

    def statuses(self, name: str) -> list[DiagnosticStatus]:
        """Return all statuses of a name, oldest first."""
        return [one for got in self.messages for one in got.status if one.name == name]

    def wait_for(self, name: str, level: bytes, after: int = 0) -> DiagnosticStatus:
        """Return the first status of a name with a level, not counting those before."""

        def found():
            return [one for one in self.statuses(name)[after:] if one.level == level]

        what = f"the level {level!r} of {name}"
        return wait_until(found, what, seen=lambda: self.statuses(name), pause=self.spin)[0]

    def close(self) -> None:
        self.node.destroy_node()
        self.executor.shutdown()
        rclpy.shutdown(context=self.context)


@pytest.fixture
def watched(make_cluster):
    """Return a cluster of two hosts, and a monitor of its domain."""
    cluster = make_cluster(host("a"), host("robot-b"), liveness=STEADY)
    with contextlib.closing(Monitor(cluster.domain)) as monitor:
        yield cluster, monitor


def test_a_monitor_sees_each_host_once_a_second(watched):
    """Names and hardware follow the conventions of ROS, and the stamp is the time of sending."""
    _, monitor = watched
    shown = monitor.wait_for("rosrm: host robot-b", DiagnosticStatus.OK)
    assert (shown.hardware_id, shown.message) == ("robot-b", "up")
    assert {"state", "memory", "cpu"} <= {one.key for one in shown.values}
    monitor.messages.clear()

    def whole() -> list[DiagnosticArray]:
        """Return the messages with all statuses; others have changes only."""
        return [one for one in monitor.messages if one.status[0].name.startswith("rosrm: master")]

    wait_until(lambda: len(whole()) > 3, "four messages", pause=monitor.spin)
    stamps = [one.header.stamp.sec + one.header.stamp.nanosec / 1e9 for one in whole()]
    # By the stamps of the master, because messages may arrive late on a busy machine.
    assert all(later - before > 0.9 for before, later in itertools.pairwise(stamps))
    assert abs(stamps[-1] - time.time()) < PATIENCE
    for message in whole():
        names = [one.name for one in message.status]
        assert len(names) == len(set(names)) == 3


def test_a_process_that_fails_is_an_error_until_it_runs_again(watched, tmp_path):
    """A monitor sees the reason and the host, and later that the process is well again."""
    cluster, monitor = watched
    cluster.submit(python("moody", MOODY.format(file=str(tmp_path / "ok"))), service("calm"))
    name = "rosrm: process moody"
    failed = monitor.wait_for(name, DiagnosticStatus.ERROR)
    assert "3" in failed.message
    assert failed.hardware_id in ("a", "robot-b")
    (tmp_path / "ok").touch()
    before = len(monitor.statuses(name))
    cluster.client.restart(["moody"])
    monitor.wait_for(name, DiagnosticStatus.OK, before)
    assert monitor.statuses("rosrm: process calm") == []


def test_a_host_that_is_silent_is_a_warning_and_then_an_error(make_cluster):
    """The processes of the host are stale, because nothing is known of them."""
    cluster = make_cluster(host("a"), liveness=LivenessSettings(suspect=1.0, lease=6.0))
    cluster.submit(service("p"))
    cluster.wait("p", "running")
    with contextlib.closing(Monitor(cluster.domain)) as monitor:
        cluster.end(cluster.slaves["a"], signal.SIGKILL)
        for level in (DiagnosticStatus.WARN, DiagnosticStatus.ERROR):
            monitor.wait_for("rosrm: host a", level)
        monitor.wait_for("rosrm: process p", DiagnosticStatus.STALE)
        monitor.wait_for("rosrm: process p", DiagnosticStatus.ERROR)
    cluster.start_slave_again("a")


def test_diagnostics_can_be_turned_off(make_cluster):
    """With `diagnostics: false` the master has no publisher of the topic."""
    cluster = make_cluster(host("a"), diagnostics=False)
    cluster.submit(service("p"))
    cluster.wait("p", "running")
    with contextlib.closing(Monitor(cluster.domain)) as monitor:
        seen = monitor.node.get_publisher_names_and_types_by_node
        wait_until(
            lambda: ("rosrm_master", "/rosrm") in monitor.node.get_node_names_and_namespaces(),
            "the node of the master", pause=monitor.spin,
        )  # fmt: skip
        wait_until(
            lambda: "/rosrm/master_beat" in dict(seen("rosrm_master", "/rosrm")),
            "the topics of the master", pause=monitor.spin,
        )  # fmt: skip
        assert "/diagnostics" not in dict(seen("rosrm_master", "/rosrm"))
