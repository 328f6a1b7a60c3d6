"""State that a node keeps across graph departure and rejoin."""

from __future__ import annotations

import math
import os
import signal
import subprocess
import sys

import pytest
from rcl_interfaces.msg import ParameterDescriptor
from rclpy.node import Node
from rclpy.parameter import Parameter
from std_msgs.msg import Int64
from std_srvs.srv import Trigger

from rosrm_criu.node.graph_departure import (
    Departure,
    await_peers,
    departure_of,
    have_acknowledged,
    others_of,
    peers_of,
    sees_again,
)
from tests.ros.nodes import RELIABLE

READER = """\
import rclpy
from std_msgs.msg import Int64
rclpy.init()
node = rclpy.create_node("reader")
node.create_subscription(Int64, "out", lambda _: None, 10)
rclpy.spin(node)
"""


def again(stage, departure: Departure, name: str = "again", **named) -> Node:
    """Return a node that starts with the parameters of a departed one."""
    overrides = departure.overrides(named.pop("parameter_overrides", None))
    return stage.add(Node(name, context=stage.context, parameter_overrides=overrides, **named))


@pytest.fixture
def node(stage):
    return stage.add(Node("first", context=stage.context, allow_undeclared_parameters=True))


@pytest.mark.parametrize(
    "value",
    [True, 7, 0.5, math.inf, "", "text", b"\x00", [True], [1, 2], [0.5], ["a", ""]],
    ids=str,
)
def test_a_parameter_keeps_its_value(stage, node, value) -> None:
    """A parameter of any type, set at run time, keeps its value in an identical declaration."""
    default = [type(value[0])()] if isinstance(value, list) else type(value)()
    default = [b"\x01"] if isinstance(value, bytes) else default
    value = [value] if isinstance(value, bytes) else value
    node.declare_parameter("p", default)
    node.set_parameters([Parameter("p", value=value)])
    copy = again(stage, departure_of(node))
    assert copy.declare_parameter("p", default).value == node.get_parameter("p").value


def test_what_is_declared_elsewhere_is_declared_again(stage, node) -> None:
    """A parameter declared by others returns with its descriptor; an unset one stays unset."""
    node.declare_parameter("limit", 3, ParameterDescriptor(description="of all", read_only=True))
    node.declare_parameter("unset", Parameter.Type.DOUBLE)
    node.declare_parameter("free", None, ParameterDescriptor(dynamic_typing=True))
    node.set_parameters([Parameter("undeclared", value="here")])
    departure = departure_of(node)
    copy = again(stage, departure)
    departure.declare_missing(copy)
    assert copy.get_parameter("limit").value == 3
    assert copy.describe_parameter("limit").description == "of all"
    assert copy.describe_parameter("limit").read_only
    assert copy.get_parameter("undeclared").value == "here"
    assert copy.get_parameter("free").value is None
    assert copy.describe_parameter("unset").type == Parameter.Type.DOUBLE.value
    assert copy.set_parameters([Parameter("unset", value=0.5)])[0].successful


def test_a_later_value_goes_before_what_the_author_gave(stage, node) -> None:
    """A value set at run time precedes the override; an override never declared is kept."""
    node.declare_parameter("speed", 2.0)
    given = [Parameter("speed", value=1.0), Parameter("later", value=5)]
    copy = again(stage, departure_of(node), parameter_overrides=given)
    assert copy.declare_parameter("speed", 0.0).value == 2.0
    assert copy.declare_parameter("later", 0).value == 5


def test_timers_go_on_in_their_period_and_only_the_same_ones(stage, node) -> None:
    """Timers match in order; a cancelled one stays so, another period is a new timer."""
    for period in (50.0, 60.0, 70.0):
        node.create_timer(period, lambda: None)
    kept, cancelled, _ = node.timers
    cancelled.cancel()
    departure = departure_of(node)
    due = kept.time_until_next_call()
    copy = again(stage, departure)
    for period in (50.0, 60.0, 80.0, 90.0):
        copy.create_timer(period, lambda: None)
    departure.start_timers(copy)
    first, second, third, fourth = copy.timers
    assert 0 < first.time_until_next_call() <= due + 1_000_000
    assert second.is_canceled()
    assert third.time_until_next_call() > 70e9
    assert fourth.time_until_next_call() > 80e9


def test_a_timer_is_back_in_its_own_period_after_the_first(stage, node) -> None:
    """The first call comes when it was due; the next ones a full period later each."""
    node.create_timer(0.5, lambda: None)
    departure = departure_of(node)
    copy, calls = again(stage, departure), []
    timer = copy.create_timer(0.5, lambda: calls.append(1))
    departure.start_timers(copy)
    assert timer.timer_period_ns < 5e8
    stage.spin_until(lambda: len(calls) == 2, "two calls")
    assert timer.timer_period_ns == 5e8


def test_a_rate_is_left_alone(stage, node) -> None:
    """The timer of a rate has no callback, and is not matched."""
    node.create_rate(10.0)
    departure = departure_of(node)
    copy = again(stage, departure)
    copy.create_rate(10.0)
    departure.start_timers(copy)


def test_peers_are_counted_by_their_ends(stage, node) -> None:
    """Two publishers of a topic are two endpoints; topics of rclpy are not counted."""
    node.create_publisher(Int64, "out", RELIABLE)
    node.create_publisher(Int64, "out", RELIABLE)
    node.create_subscription(Int64, "in", lambda _: None, RELIABLE)
    stage.plain.create_subscription(Int64, "out", lambda _: None, RELIABLE)
    expected = {"readers of /out": 1, "readers of /out (2)": 1, "writers of /in": 0}
    stage.spin_until(lambda: peers_of(node) == expected, "one reader of each")


def test_missing_peers_are_named_when_patience_ends(node) -> None:
    """The result names missing peers only, of endpoints that exist again."""
    node.create_publisher(Int64, "out", RELIABLE)
    node.create_subscription(Int64, "in", lambda _: None, RELIABLE)
    before = {"readers of /out": 2, "writers of /in": 0, "a server of /gone": 1}
    assert await_peers(node, before, 0.02) == ("readers of /out: 0 of 2",)


def test_a_sample_is_missed_until_its_reader_acknowledges(stage, node) -> None:
    """`have_acknowledged` is False while the reader is stopped, and True after it continues."""
    output = node.create_publisher(Int64, "out", RELIABLE)
    domain = str(node.context.get_domain_id())
    environment = {**os.environ, "ROS_DOMAIN_ID": domain}
    reader = subprocess.Popen([sys.executable, "-c", READER], env=environment)
    try:
        stage.spin_until(lambda: output.get_subscription_count() == 1, "the reader")
        stage.spin_until(lambda: have_acknowledged(node), "no sample that is missed")
        reader.send_signal(signal.SIGSTOP)
        os.waitid(os.P_PID, reader.pid, os.WSTOPPED)
        output.publish(Int64(data=1))
        assert not have_acknowledged(node)
        reader.send_signal(signal.SIGCONT)
        stage.spin_until(lambda: have_acknowledged(node), "the acknowledgement")
    finally:
        reader.kill()
        reader.wait()


def test_ends_of_others_are_counted(stage, node) -> None:
    """Endpoints of other nodes on the node's topics and clients are counted, no others."""
    node.create_publisher(Int64, "out", RELIABLE)
    node.create_subscription(Int64, "out", lambda _: None, RELIABLE)
    node.create_subscription(Int64, "in", lambda _: None, RELIABLE)
    node.create_client(Trigger, "poke")
    other = stage.add(Node("other", context=stage.context))
    other.create_subscription(Int64, "out", lambda _: None, RELIABLE)
    other.create_subscription(Int64, "elsewhere", lambda _: None, RELIABLE)
    other.create_publisher(Int64, "in", RELIABLE)
    other.create_service(Trigger, "poke", lambda _, response: response)
    expected = {
        ("subscribers", "/out"): 1,
        ("publishers", "/out"): 0,
        ("publishers", "/in"): 1,
        ("services", "/poke"): 1,
    }
    stage.spin_until(lambda: others_of(node) == expected, "the other node's ends")
    stranger = stage.add(Node("stranger", context=stage.context))
    assert sees_again(stranger, {**expected, ("subscribers", "/out"): 2}, 5.0)
    assert not sees_again(stranger, {("subscribers", "/out"): 3}, 0.02)
