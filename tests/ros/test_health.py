"""Health checks: silent, hanging or inactive real nodes are ended although they are alive."""

from __future__ import annotations

import os
import re
import signal
import sys
from dataclasses import replace

import pytest
import rclpy
from builtin_interfaces.msg import Time
from rclpy.executors import SingleThreadedExecutor
from rclpy.parameter import Parameter
from rosgraph_msgs.msg import Clock
from std_msgs.msg import Int64, String

from rosrm import clocks
from rosrm.core.slave.watches import NoState, Watch
from rosrm.model.values import Health, MigrationPolicy, RestartPolicy
from rosrm.ros.slave.graph import GraphWatch
from rosrm.ros.slave.health import HealthMonitor
from tests.ros.clusters import SPIN, STEADY, alive, host, node, service
from tests.waiting import wait_gone, wait_until

#: Seconds: far more than a busy machine takes between two messages.
SOON = 2.0
#: A fault that lasts for SOON, or on a busy machine for longer.
FOR_2_S = r"for ([2-9]|\d\d)\.\d"
AGAIN = RestartPolicy("on-failure", delay=0.2)

#: A lifecycle node that publishes at 20 Hz. `last`: number of the last message; `leaves`: leave the
#: active state with that message.
TALKER = (
    """
import rclpy, sys
from rclpy.lifecycle import LifecycleNode
from std_msgs.msg import Int64
rclpy.init()
node = LifecycleNode("unnamed")
last = node.declare_parameter("last", 0).value
leaves = node.declare_parameter("leaves", False).value
output = node.create_publisher(Int64, "~/scan", 1)
count = 0

def tick():
    global count
    count += 1
    if not last or count <= last or leaves:
        output.publish(Int64(data=count))
    if leaves and count == last:
        node.trigger_deactivate()

timer = node.create_timer(0.05, tick)
node.trigger_configure()
node.trigger_activate()
"""
    + SPIN
)

#: A node that publishes an absolute topic name with a given type.
SPEAKER = (
    """
import rclpy, std_msgs.msg
rclpy.init()
node = rclpy.create_node("unnamed")
kind = getattr(std_msgs.msg, node.declare_parameter("type", "").value)
output = node.create_publisher(kind, "/clash", 1)
timer = node.create_timer(0.05, lambda: output.publish(kind()))
"""
    + SPIN
)

#: Seconds without a core that a healthy node survives on a busy machine.
STARVED = 10.0
SCAN = Health("~/scan", 2.0, "active", SOON)


@pytest.fixture(scope="module")
def cluster(make_shared):
    """Yield a cluster with a node that stays healthy."""
    cluster = make_shared(host("h0"))
    health = replace(SCAN, timeout=STARVED)
    cluster.submit(node("healthy", TALKER, namespace="/robot", health=health, restart=AGAIN))
    cluster.wait("healthy", "running")
    return cluster


@pytest.fixture(scope="module")
def reasons(cluster) -> dict[str, str]:
    """Return the reasons of processes that fail at once, each because it is unhealthy."""
    robot = {"namespace": "/robot"}
    cluster.submit(
        node(
            "quiet", TALKER, **robot, parameters={"last": 40},
            remappings={"~/scan": "front/scan"}, health=Health("~/scan", 5.0, "", SOON),
        ),
        node("mute", TALKER, **robot, health=Health("scan", 1.0, "", SOON)),
        node("idle", TALKER, parameters={"last": 40, "leaves": True}, health=SCAN),
        service("plain", health=Health(timeout=SOON)),
    )  # fmt: skip
    os.kill(cluster.wait("plain", "running").pid, signal.SIGSTOP)
    return {name: failed(cluster, name) for name in ("quiet", "mute", "idle", "plain")}


def failed(cluster, name: str) -> str:
    """Wait until a process has failed; return the reason."""
    row = cluster.ended(name)
    assert row.state == "failed"
    assert not alive(row.pid)
    return row.reason


def test_a_topic_that_falls_silent(cluster, reasons) -> None:
    """A silent node is ended; the reason has the measured and the required rate."""
    assert re.match(rf"unhealthy: ~/scan: 0\.0 Hz {FOR_2_S}", reasons["quiet"])
    assert reasons["quiet"].endswith("at least 5 Hz are required")
    assert cluster.client.explain("quiet")["reason"].startswith(reasons["quiet"])


def test_a_topic_that_nobody_publishes(reasons) -> None:
    """The reason has the full name of a topic that never existed."""
    assert re.search(f"scan: not published as /robot/scan {FOR_2_S}", reasons["mute"])


def test_a_node_that_leaves_its_lifecycle_state(reasons) -> None:
    """The node keeps publishing, but is no longer active."""
    assert re.match(f"unhealthy: lifecycle state inactive {FOR_2_S}", reasons["idle"])


def test_a_process_without_ros_that_is_stopped(reasons) -> None:
    """With only a timeout given, a process must not be paused for longer."""
    assert re.match(rf"unhealthy: stopped by a signal \(SIGSTOP\) {FOR_2_S}", reasons["plain"])


def test_a_node_that_is_stopped_starts_again(cluster) -> None:
    """A node paused by SIGSTOP is killed, and its restart policy starts another process."""
    cluster.submit(node("hung", TALKER, health=SCAN, restart=AGAIN))
    before = cluster.wait("hung", "running")
    os.kill(before.pid, signal.SIGSTOP)
    event = cluster.wait_for_event("backoff", "unhealthy: ", process="hung")
    assert "restart 1 of 5" in event.message
    wait_gone(before.pid)
    assert cluster.wait("hung", "running", restarts=1).number == before.number
    history = cluster.client.explain("hung")["history"]
    assert any("unhealthy: " in entry["message"] for entry in history)
    cluster.cancel("hung")


def test_a_topic_of_two_types(cluster) -> None:
    """A node's own publisher counts, despite others of another type; without one both are named."""
    health = Health("/clash", 2.0, "", SOON)
    cluster.submit(
        node("numbers", SPEAKER, parameters={"type": "Int64"}, health=health),
        node("words", SPEAKER, parameters={"type": "String"}),
    )
    cluster.wait("numbers", "running")
    cluster.wait("words", "running")
    cluster.submit(node("neither", TALKER, health=health))
    reason = failed(cluster, "neither")
    types = "std_msgs/msg/Int64 and std_msgs/msg/String"
    assert re.search(f"/clash: published as {types} {FOR_2_S}", reason)
    assert cluster.process("numbers").state == "running"
    assert cluster.process("numbers").restarts == 0
    cluster.cancel("numbers", "words")


def test_the_next_run_of_the_slave_watches_on(cluster) -> None:
    """The supervisor stores the health check for the next slave, whose downtime does not count."""
    cluster.submit(service("orphan", health=Health(timeout=SOON)))
    pid = cluster.wait("orphan", "running").pid
    cluster.start_slave_again("h0")
    os.kill(pid, signal.SIGSTOP)
    assert failed(cluster, "orphan").startswith("unhealthy: stopped by a signal")


def test_a_healthy_node_is_never_ended(cluster) -> None:
    """A healthy node, watched by two runs of the slave, and for a while longer here, is kept."""
    cluster.stays(2 * SOON, lambda: cluster.process("healthy").restarts == 0, "the first run")
    cluster.wait("healthy", "running", restarts=0)


#: A stateful node, whose output is below its name even under an alias.
COUNTER = """
import rclpy
from std_msgs.msg import Int64
from rosrm.node import Node

class Counter(Node):
    def __init__(self):
        super().__init__("counter")
        self.count = 0
        self.output = self.create_publisher(Int64, "~/count", 10)
        self.create_timer(0.02, self.tick)
        self.keep_state("~/state", Int64, lambda: Int64(data=self.count), self.restore)

    def tick(self):
        self.count += 1
        self.output.publish(Int64(data=self.count))

    def restore(self, state):
        self.count = state.data

rclpy.init()
try:
    rclpy.spin(Counter())
except BaseException:  # as in SPIN
    pass
"""


def test_a_node_that_was_moved_is_watched_where_it_is_now(make_cluster) -> None:
    """A silent shadow is not unhealthy; on its new host a paused node is restarted."""
    cluster = make_cluster(host("h0"), host("h1"), liveness=STEADY)
    migration = MigrationPolicy("handoff")
    health = Health("~/count", 5.0, "", SOON)
    cluster.submit(node("moved", COUNTER, health=health, restart=AGAIN, migration=migration))
    before = cluster.wait("moved", "running")
    cluster.client.migrate("moved")
    cluster.wait_for_event("migrated", process="moved")
    after = cluster.wait("moved", "running")
    assert after.host != before.host
    cluster.stays(2 * SOON, lambda: cluster.process("moved").restarts == 0, "healthy")
    os.kill(after.pid, signal.SIGSTOP)
    event = cluster.wait_for_event("backoff", "unhealthy: ", process="moved")
    assert event.host == after.host
    cluster.wait("moved", "running", restarts=1)


# --- reception in the slave ---------------------------------------------------------------------


class Listener:
    """A health subscription of a slave, and its publisher.

    Args:
        stage: stage of the nodes.
        rate: required rate.
    """

    def __init__(self, stage, rate: float) -> None:
        self.node = stage.plain
        watch = Watch(Health("/scan", rate, "", SOON), ("/scan",))
        self.ear = HealthMonitor(self.node, GraphWatch(self.node), watch, clocks.boot_time())

    def look(self) -> tuple[int | None, str]:
        return self.ear.topic((os.getpid(),), clocks.boot_time())

    def look_until(self, condition, what: str) -> tuple[int | None, str]:
        looks = []

        def met() -> bool:
            looks.append(self.look())
            return condition(looks[-1])

        wait_until(met, what, seen=lambda: looks[-1])
        return looks[-1]


@pytest.mark.parametrize("alone", [True, False])
def test_what_is_published_is_counted_though_little_of_it_is_kept(stage, alone) -> None:
    """The slave keeps one second's worth of messages, and counts a flood by sequence numbers.

    Sequence numbers of two publishers would be mixed up, so then only received messages count.
    """
    listener = Listener(stage, rate=5.0)
    output = stage.plain.create_publisher(Int64, "/scan", 1000)
    if not alone:
        stage.plain.create_publisher(Int64, "/scan", 1000)
    listener.look_until(lambda look: look[0] is not None, "matched")

    def heard(look) -> bool:
        output.publish(Int64())
        return bool(look[0])

    listener.look_until(heard, "a message")
    for _ in range(500):
        output.publish(Int64())
    counts: list[int] = []

    def all_counted(look) -> bool:
        counts.append(look[0])
        return sum(counts) >= (500 if alone else 6)

    listener.look_until(all_counted, f"all of them, {counts}")
    assert alone or max(counts) <= 6
    listener.ear.close()


def test_a_type_that_this_host_does_not_know(stage, monkeypatch) -> None:
    """The trouble names the missing type; once the type is available, messages count."""
    stage.plain.create_publisher(String, "/scan", 1)
    listener = Listener(stage, rate=5.0)
    with monkeypatch.context() as patch:
        patch.setitem(sys.modules, "std_msgs.msg", None)
        look = listener.look_until(lambda look: "not published" not in look[1], "published")
        assert look[0] is None
        assert look[1].startswith("cannot be listened to on this host (ModuleNotFoundError: ")
        assert "std_msgs.msg" in look[1]
    listener.look_until(lambda look: look[0] is not None, "listened to")
    listener.ear.close()


def test_another_type_is_followed(stage) -> None:
    """The slave subscribes again when a publisher returns with another type."""
    listener = Listener(stage, rate=5.0)
    first = stage.plain.create_publisher(String, "/scan", 1)
    listener.look_until(lambda look: look[0] is not None, "a message of the first")
    stage.plain.destroy_publisher(first)
    listener.look_until(lambda look: "not published" in look[1], "it is gone")
    stage.plain.create_publisher(Int64, "/scan", 1)
    listener.look_until(lambda look: look[0] is not None, "a message of the second")
    listener.ear.close()


def test_a_name_that_is_none_harms_nobody(stage) -> None:
    """The slave reports an invalid topic name and keeps running."""
    watch = Watch(Health("no topic", 1.0, "active", SOON), ("/no topic",), ("/no-node/get_state",))
    ear = HealthMonitor(stage.plain, GraphWatch(stage.plain), watch, clocks.boot_time())
    heard, trouble = ear.topic((1,), clocks.boot_time())
    assert heard is None
    assert "cannot be listened to" in trouble
    assert ear.state(clocks.boot_time() + 60.0) is NoState.NO_ANSWER
    ear.close()


def test_a_client_that_cannot_be_created_is_no_silence_of_the_node(stage, monkeypatch) -> None:
    """For want of memory or descriptors; the slave would end the node as unhealthy."""
    watch = Watch(Health("", 0.0, "active", SOON), (), ("/lidar/get_state",))

    def refuse(*_: object, **__: object) -> None:
        raise RuntimeError("failed to create client: out of memory")

    with monkeypatch.context() as shortage:
        shortage.setattr(stage.plain, "create_client", refuse)
        ear = HealthMonitor(stage.plain, GraphWatch(stage.plain), watch, 0.0)
        with pytest.raises(RuntimeError, match="out of memory"):
            ear.state(60.0)
    assert ear.state(60.1) is NoState.NOT_YET
    assert ear.state(120.0) is NoState.NO_ANSWER
    ear.close()


@pytest.mark.parametrize("simulated", [True, False])
def test_the_clock_of_a_node_is_that_which_the_node_uses(stage, simulated) -> None:
    """The slave asks the node, because a launch or parameter file may set `use_sim_time`."""
    context = stage.plain.context
    override = [Parameter("use_sim_time", value=simulated)]
    node = rclpy.create_node("lidar", context=context, parameter_overrides=override)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(node)
    clock = stage.plain.create_publisher(Clock, "/clock", 1)
    watch = Watch(Health("/scan", 5.0, "", SOON), ("/scan",), parameters=("/lidar/get_parameters",))
    ear = HealthMonitor(stage.plain, GraphWatch(stage.plain), watch, clocks.boot_time())
    seen: list[float | None] = []

    def answered() -> bool:
        clock.publish(Clock(clock=Time(sec=12, nanosec=500_000_000)))
        executor.spin_once(timeout_sec=0.05)
        seen.append(ear.clock(clocks.boot_time()))
        return ear._time._is_simulated is not None and seen[-1] == (12.5 if simulated else None)

    wait_until(answered, "the node has answered", seen=lambda: seen[-3:])
    ear.close()
    executor.shutdown()
    node.destroy_node()
