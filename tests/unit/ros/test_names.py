"""Names of topics and services: valid in ROS, and different for different hosts."""

from __future__ import annotations

import re
import string

from hypothesis import example, given, settings
from hypothesis import strategies as st
from rclpy.validate_full_topic_name import validate_full_topic_name
from rclpy.validate_node_name import validate_node_name

from rosrm.ros.names import Names, token

#: Most bytes of a file name on Linux.
LONGEST_FILE_NAME = 255

AWKWARD = {
    "robot-1", "robot_1", "robot.1", "robot--1", "robot_1_bd82fad2", "Robot_1", "ROBOT-1", "3d",
    "h3d", "host_3d", "-", "_", "host", "a__b", "a_b", "a_", "a", "ö", "Ω-1", "..", "/", "a\0",
    "a\n", "x" * 64, "x" * 65, "x" * 100, "x" * 64 + "-", "\ud800",
}  # fmt: skip


def derived(name: str) -> set[str]:
    """Return names that a colliding token would need: tokens, tokens of tokens, near misses."""
    own = token(name)
    return {
        own, token(own), own + "_", own.upper(), own.replace("_", "-"), own[:-1], name + own[-33:],
        f"host_{name}", f"host_{own}", name.swapcase(), name.strip("_-"),
    } - {""}  # fmt: skip


#: Letters of which most drawn names collide, once the other characters are replaced.
NEAR = st.text(alphabet="aA_-.1", min_size=1, max_size=6)
LONG = st.text(alphabet="x_-", min_size=60, max_size=70)
HOSTILE = st.sets(NEAR | LONG | st.text(min_size=1, max_size=8), min_size=1, max_size=40)


def test_a_plain_name_stays() -> None:
    """A valid name is easy to recognise in `ros2 service list`."""
    assert Names("/rosrm").of_host("robot_1", "control") == "/rosrm/host/robot_1/control"
    assert token("map_20261122") == "map_20261122"


@given(st.text(alphabet=string.ascii_letters + string.digits + "-. ", min_size=1, max_size=64))
def test_an_ordinary_name_stays_readable(name) -> None:
    """The token has the letters and digits of the name in their order."""
    plain = re.sub(r"[^A-Za-z0-9]+", "_", name).strip("_")
    assert plain in token(name)


def test_a_name_like_the_token_of_another_has_another_token() -> None:
    """Otherwise one host would execute the orders for the other."""
    assert token("robot-1") != token("robot_1_bd82fad2")
    assert token(token("robot-1")) != token("robot-1")


@settings(deadline=None)
@given(HOSTILE)
@example({"robot-1"})
def test_different_hosts_have_different_valid_names(drawn) -> None:
    """All servers of a name execute a request, so robot-1 must not receive requests for robot_1.

    The names of services and of the node are valid in ROS, and the token names a directory.
    """
    hosts = {*AWKWARD, *drawn}
    hosts |= {name for host in hosts for name in derived(host)}
    tokens = {token(host) for host in hosts}
    assert len(tokens) == len(hosts)
    for name in tokens:
        assert len(f"{name}.new".encode()) <= LONGEST_FILE_NAME
        validate_node_name(f"rosrm_slave_{name}")
    for host in (*AWKWARD, *drawn):
        validate_full_topic_name(Names("/rosrm").of_host(host, "control"))
        validate_full_topic_name(Names("/rosrm").of_handoff(host, 2**64 - 1))
