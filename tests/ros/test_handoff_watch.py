"""The executor `handoff_watch`, which waits for a second real publisher of any QoS."""

from __future__ import annotations

import contextlib
import threading

import pytest
import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.signals import SignalHandlerOptions
from std_msgs.msg import Int64, String

from rosrm.testing.local_cluster import claim_domain
from rosrm_migration.handoff import watch
from tests.waiting import PATIENCE, wait_until

LATCHED = QoSProfile(
    depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL
)
LOSSY = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
TOPIC = "/watched/state"


@pytest.fixture(autouse=True)
def domain(monkeypatch):
    """Claim a domain that no cluster of the tests uses."""
    number, claim = claim_domain()
    monkeypatch.setenv("ROS_DOMAIN_ID", str(number))
    with claim:
        yield


@contextlib.contextmanager
def publishing(name: str, qos: QoSProfile = LATCHED, kind: type = Int64, period: float = 0.02):
    """Run a node that publishes its state in every cycle, in its own participant."""
    context = rclpy.Context()
    rclpy.init(context=context, signal_handler_options=SignalHandlerOptions.NO)
    node = Node(name, context=context)
    publisher = node.create_publisher(kind, TOPIC, qos)
    node.create_timer(period, lambda: publisher.publish(kind()))
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(node)
    thread = threading.Thread(target=executor.spin, daemon=True)
    thread.start()
    try:
        yield node
    finally:
        executor.shutdown()
        thread.join(5.0)
        node.destroy_node()
        context.try_shutdown()


def listen(timeout: float = 20.0):
    """Watch the topic as the slave does."""
    return watch(arguments("std_msgs/msg/Int64", timeout))


def arguments(kind: str, timeout: float):
    names = {"source": "source", "destination": "destination"}
    return {"state": TOPIC, "type": kind, "timeout": timeout, **names}


@pytest.mark.parametrize("qos", [LATCHED, LOSSY])
def test_a_second_publisher_is_heard(qos):
    """The watch ends only after the first message of the second publisher."""
    heard = []
    with publishing("source", qos):
        thread = threading.Thread(target=lambda: heard.append(listen()))
        thread.start()
        thread.join(1.0)
        assert thread.is_alive()
        with publishing("destination", qos):
            thread.join(PATIENCE)
    (result,) = heard
    assert result["heard"] > 10
    assert result["seconds"] > 0.9


def test_a_second_publisher_that_was_first_is_heard():
    """A watch that begins late finds both publishers active."""
    with publishing("source"), publishing("destination") as destination:
        wait_until(lambda: destination.count_publishers(TOPIC) == 2, "both publishers")
        assert listen()["heard"] > 1


def test_one_publisher_alone_is_said():
    with publishing("source"), pytest.raises(TimeoutError, match="only one publisher of /watched"):
        listen(5.0)


def test_nobody_is_said():
    with pytest.raises(TimeoutError, match="no node publishes /watched/state, in 1 s"):
        listen(1.0)


def test_another_type_is_said():
    expected = "/watched/state is published as std_msgs/msg/String, not std_msgs/msg/Int64"
    with publishing("source", kind=String), pytest.raises(TimeoutError, match=expected):
        listen(5.0)


def test_an_unknown_type_is_said():
    with pytest.raises(ValueError, match="no message type 'no_msgs/msg/Int64' on this host"):
        watch(arguments("no_msgs/msg/Int64", 1.0))


def test_another_publisher_is_not_taken_for_the_destination():
    """A third publisher, e.g. a played bag, hides the destination's messages: an error."""
    with (
        publishing("source"), publishing("player"),
        pytest.raises(ValueError, match="/watched/state is also published by player"),
    ):  # fmt: skip
        listen()
