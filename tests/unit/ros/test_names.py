"""Names of topics and services: valid in ROS, and different for different hosts."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st
from rclpy.validate_full_topic_name import validate_full_topic_name
from rclpy.validate_node_name import validate_node_name

from rosrm.ros.names import Names, token

AWKWARD = {
    "robot-1", "robot_1", "robot.1", "robot--1", "3d", "h3d", "-", "_", "a__b", "a_", "ö", "Ω-1",
    "x" * 100,
}  # fmt: skip


def test_a_plain_name_stays() -> None:
    """A valid name is easy to recognise in `ros2 service list`."""
    assert Names("/rosrm").of_host("robot_1", "control") == "/rosrm/host/robot_1/control"


@given(st.sets(st.text(min_size=1, max_size=8)).map(lambda some: {*AWKWARD, *some}))
def test_different_hosts_have_different_valid_names(hosts) -> None:
    """All servers of a name execute a request, so robot-1 must not receive requests for robot_1.

    The names of services and of the node are valid in ROS.
    """
    assert len({token(host) for host in hosts}) == len(hosts)
    for host in hosts:
        validate_full_topic_name(Names("/rosrm").of_host(host, "control"))
        validate_node_name(f"rosrm_slave_{token(host)}")
