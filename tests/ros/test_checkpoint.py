"""Checkpoint and restore of processes on their host, seen by subscribers of their topics."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from itertools import pairwise

import pytest
import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import QoSProfile
from std_msgs.msg import Int64, Int64MultiArray

from rosrm.config.settings import MigrationSettings, ProcessDefaults
from rosrm.errors import Refused
from rosrm.model.rows import ProcessRow
from rosrm.model.values import MigrationPolicy, ProcessSpec, RestartPolicy
from tests.ros.clusters import (
    MIB,
    PATIENCE,
    QUICK,
    SPIN,
    STEADY,
    alive,
    host,
    node,
    python,
    wait_until,
)
from tests.ros.portable_kit import AS_ROOT

pytestmark = pytest.mark.timeout(240)

#: Publishes one number after the other.
COUNTER = (
    """
import rclpy
from rclpy.qos import QoSProfile
from std_msgs.msg import Int64
rclpy.init()
node = rclpy.create_node("unnamed")
output, count = node.create_publisher(Int64, "count", QoSProfile(depth=1000)), 0
def tick():
    global count
    count += 1
    output.publish(Int64(data=count))
timer = node.create_timer(0.02, tick)
"""
    + SPIN
)


class Listener:
    """Subscriber of the counts: numbers, or arrays that begin with one."""

    def __init__(self, domain: int, kind: type = Int64) -> None:
        self._context = rclpy.Context()
        self._context.init(domain_id=domain)
        self._node = rclpy.create_node("listener", context=self._context)
        self._node.create_subscription(kind, "count", self._take, QoSProfile(depth=1000))
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)
        self.counts: list[int] = []

    def _take(self, message: Int64 | Int64MultiArray) -> None:
        data = message.data
        self.counts.append(data if isinstance(message, Int64) else data[0])

    def receive(self, more: int) -> None:
        """Wait for this number of further counts."""
        wanted, deadline = len(self.counts) + more, time.monotonic() + PATIENCE
        while len(self.counts) < wanted:
            assert time.monotonic() < deadline, f"{len(self.counts)} counts of {wanted}"
            self._executor.spin_once(0.1)

    def listen(self, seconds: float) -> None:
        """Receive counts for some seconds."""
        deadline = time.monotonic() + seconds
        while time.monotonic() < deadline:
            self._executor.spin_once(0.05)

    def close(self) -> None:
        self._node.destroy_node()
        self._context.try_shutdown()


@pytest.fixture
def cluster(make_cluster):
    """Return a cluster of one host."""
    return make_cluster(
        host("robot"), liveness=STEADY,
        migration=MigrationSettings(strategies={"relaunch": {}, "criu": {}}, automatic=False),
        defaults=ProcessDefaults(needs={"memory": MIB}),
    )  # fmt: skip


@pytest.fixture
def listener(cluster) -> Iterator[Listener]:
    listener = Listener(cluster.domain)
    yield listener
    listener.close()


def counter(**fields) -> ProcessSpec:
    fields.setdefault("restart", RestartPolicy("on-failure", delay=0.1))
    return node("counter", COUNTER, **fields)


def ask(cluster, action: str, name: str) -> None:
    """Request an action as soon as the host has reported its capabilities."""
    deadline = time.monotonic() + PATIENCE
    while True:
        try:
            getattr(cluster.client, action)(name)
        except Refused as refusal:
            if "not known yet" not in str(refusal) or time.monotonic() > deadline:
                raise
            cluster.client.spin(0.1)
        else:
            return


def checkpoint(cluster, name: str) -> ProcessRow:
    """Checkpoint a process, and check that its pid is gone."""
    pid = cluster.process(name).pid
    ask(cluster, "checkpoint", name)
    row = cluster.wait(name, "checkpointed")
    assert (row.host, row.reason, row.pid) == ("robot", "its image is on robot", 0)
    assert not alive(pid)
    return row


def restore(cluster, name: str) -> None:
    ask(cluster, "restore", name)
    row = cluster.wait(name, "running", "checkpointed")
    assert row.state == "running", row.reason


def require_udp() -> None:
    """Skip the test where participants cannot be limited to UDP."""
    if os.environ.get("FASTDDS_BUILTIN_TRANSPORTS") != "UDPv4":
        pytest.skip("a network of its own, with UDPv4 alone, may not be made here")


@pytest.mark.parametrize("away", [0.0, 5.0])
def test_a_subscriber_receives_the_counts_of_a_restored_node(criu, cluster, listener, away):
    """No count is missing after two restores; a node that joins before them takes no port of it."""
    require_udp()
    cluster.submit(counter())
    cluster.wait("counter", "running")
    listener.receive(50)
    for _ in range(2):
        checkpoint(cluster, "counter")
        listener.listen(away)
        other = Listener(cluster.domain)
        restore(cluster, "counter")
        listener.receive(50)
        other.close()
    assert listener.counts == list(range(listener.counts[0], listener.counts[-1] + 1))
    cluster.cancel("counter")


def test_the_restart_policy_restarts_a_restored_node_from_its_beginning(criu, cluster, listener):
    """An image serves one restore, so after a crash the counts begin at 1 again."""
    require_udp()
    cluster.submit(counter())
    cluster.wait("counter", "running")
    listener.receive(10)
    checkpoint(cluster, "counter")
    restore(cluster, "counter")
    listener.receive(10)
    os.kill(cluster.process("counter").pid, 9)
    deadline = time.monotonic() + PATIENCE
    while all(before < after for before, after in pairwise(listener.counts)):
        assert time.monotonic() < deadline, "no count was lower than the one before"
        listener.listen(0.1)
    cluster.cancel("counter")


def rosrm(cluster, *words: str) -> subprocess.CompletedProcess:
    """Run a command of rosrm, which joins the ROS graph on this host."""
    environment = {**os.environ, "ROS_DOMAIN_ID": str(cluster.domain), "COLUMNS": "200"}
    return subprocess.run(
        [sys.executable, "-m", "rosrm.cli", *words],
        env=environment, text=True, capture_output=True, timeout=2 * PATIENCE, check=False,
    )  # fmt: skip


def test_checkpoint_and_restore_with_wait_end_after_the_action(criu, cluster, listener):
    """The commands join the graph on the same host, and take no port of the process."""
    require_udp()
    cluster.submit(counter())
    cluster.wait("counter", "running")
    listener.receive(20)
    checkpoint(cluster, "counter")  # its host is known to be able
    restore(cluster, "counter")
    for action, said in (
        ("checkpoint", "counter is checkpointed: its image is on robot"),
        ("restore", "counter was restored from its image on robot"),
    ):
        done = rosrm(cluster, action, "counter", "--wait")
        assert (done.returncode, said in done.stdout) == (0, True), done.stdout + done.stderr
    listener.receive(20)
    assert listener.counts == list(range(listener.counts[0], listener.counts[-1] + 1))
    refused = rosrm(cluster, "restore", "counter", "--wait")
    assert refused.returncode != 0
    assert "only a checkpointed process is restored" in refused.stderr
    cluster.cancel("counter")


def test_a_portable_node_can_migrate_after_a_restore(criu, make_cluster):
    """A checkpoint does not ask the node to leave the graph; a later migration does."""
    require_udp()
    cluster = make_cluster(
        host("left", strategies=AS_ROOT), host("right", strategies=AS_ROOT), liveness=STEADY,
        migration=MigrationSettings(strategies={"criu": {}}, automatic=False),
        defaults=ProcessDefaults(needs={"memory": MIB}),
    )  # fmt: skip
    listener = Listener(cluster.domain, Int64MultiArray)
    try:
        cluster.submit(
            ProcessSpec(
                "p", module="rosrm_examples.portable_counter", arguments=("--period", "0.02"),
                ros=True, migration=MigrationPolicy("criu"), stop=QUICK,
            )
        )  # fmt: skip
        here = cluster.wait("p", "running").host
        listener.receive(20)
        ask(cluster, "checkpoint", "p")
        assert cluster.wait("p", "checkpointed").host == here
        restore(cluster, "p")
        listener.receive(20)
        assert listener.counts == list(range(listener.counts[0], listener.counts[-1] + 1))
        ask(cluster, "migrate", "p")
        cluster.wait_for_event("migrated", process="p", timeout=2 * PATIENCE)
        assert cluster.wait("p", "running").host != here
        listener.receive(20)
        assert all(before < after for before, after in pairwise(listener.counts))
        cluster.cancel("p")
    finally:
        listener.close()


def test_the_refusal_of_a_node_with_shared_memory_names_the_setting(criu, cluster, listener):
    """Peers would remove the shared memory of a dumped node. The node keeps running."""
    require_udp()
    cluster.submit(counter(environment={"FASTDDS_BUILTIN_TRANSPORTS": "DEFAULT"}))
    cluster.wait("counter", "running")
    listener.receive(10)
    ask(cluster, "checkpoint", "counter")
    event = cluster.wait_for_event("checkpoint_failed", process="counter")
    assert "its ROS participant has shared memory (/dev/shm/fastrtps_" in event.message
    assert "`FASTDDS_BUILTIN_TRANSPORTS: UDPv4` in its `environment`" in event.message
    listener.receive(10)
    cluster.cancel("counter")


def test_a_process_that_cannot_be_dumped_keeps_running(criu, cluster, tmp_path):
    """The record gives the reason: a Unix socket connected to another process."""
    with socket.socket(socket.AF_UNIX) as server:
        server.bind(str(tmp_path / "s"))
        server.listen()
        code = (
            f"import socket, time\none = socket.socket(socket.AF_UNIX)\n"
            f"one.connect({str(tmp_path / 's')!r})\ntime.sleep(1000)"
        )
        cluster.submit(python("tied", code))
        cluster.wait("tied", "running")
        server.settimeout(PATIENCE)
        held, _ = server.accept()
        pid = cluster.process("tied").pid
        ask(cluster, "checkpoint", "tied")
        event = cluster.wait_for_event("checkpoint_failed", process="tied")
        assert "tied was not checkpointed and still runs on robot" in event.message
        assert "is a Unix socket that is connected to" in event.message
        assert cluster.wait("tied", "running").pid == pid
        held.close()
    cluster.cancel("tied")


def test_an_image_outlives_slave_and_master(criu, cluster):
    """A checkpointed process stays on its host; a cancel removes its image."""
    count = (
        "import time\nn = 0\n"
        "while True:\n    n += 1\n    print(n, flush=True)\n    time.sleep(0.01)\n"
    )
    for name in ("plain", "unwanted"):
        cluster.submit(python(name, count))
        cluster.wait(name, "running")
        cluster.wait_for_log(name, "20")
        checkpoint(cluster, name)
    for part in cluster.parts():
        part.end(signal.SIGKILL)
        part.process.wait(PATIENCE)
    cluster.start_master()
    cluster.reconnect()
    cluster.start_slave(cluster.hosts[0])
    cluster.wait_for_hosts()
    restore(cluster, "plain")
    cluster.wait_for_log("plain", "\n")
    first = int(cluster.log("plain").split()[0])
    assert first > 20, "the count began again"
    images = cluster.directory / "hosts" / "robot" / "images"
    assert list(images.glob("kept-*"))
    cluster.cancel("unwanted", "plain")
    wait_until(lambda: not list(images.glob("kept-*")), "the removal of the image")


def test_a_checkpoint_is_refused_on_a_host_without_criu(make_cluster, monkeypatch, tmp_path):
    """The process keeps running."""
    monkeypatch.setenv("ROSRM_CRIU", str(tmp_path / "none"))
    cluster = make_cluster(
        host("robot"), migration=MigrationSettings(strategies={"criu": {}}, automatic=False)
    )
    cluster.submit(ProcessSpec("p", command=("sleep", "1000"), stop=QUICK))
    cluster.wait("p", "running")
    with pytest.raises(Refused, match="criu does not work on robot: "):
        ask(cluster, "checkpoint", "p")
    assert cluster.process("p").state == "running"
    cluster.cancel("p")
