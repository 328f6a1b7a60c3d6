"""The settings of Fast DDS that a node makes itself with."""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree as ET

import pytest

from rosrm.ros.fast_dds import announcements, announcing


def test_fast_dds_is_given_a_profile_while_the_node_is_made():
    """And what the process starts later is not."""
    environment = {"HOME": "/home/robot"}
    with announcing(environment, "movable"):
        (profile,) = set(environment) - {"HOME"}
        text = Path(environment[profile]).read_text()
    assert "heartbeatPeriod" in text
    assert ET.fromstring(text.split("-->", 1)[1]).tag.endswith("profiles")
    assert environment == {"HOME": "/home/robot"}


@pytest.mark.parametrize("pace", ["eager", "steady"])
def test_the_parts_speak_udp_alone(pace):
    """What killed processes leave in shared memory must not hold them up."""
    assert announcements({}, pace)["FASTDDS_BUILTIN_TRANSPORTS"] == "UDPv4"


@pytest.mark.parametrize("pace", ["eager", "steady"])
def test_the_users_choice_of_transports_stands(pace):
    """Also where it is shared memory."""
    chosen = {"FASTDDS_BUILTIN_TRANSPORTS": "SHM"}
    assert "FASTDDS_BUILTIN_TRANSPORTS" not in announcements(chosen, pace)


def test_transports_of_nodes_are_the_users():
    """Large messages may need shared memory."""
    assert "FASTDDS_BUILTIN_TRANSPORTS" not in announcements({}, "movable")


def test_a_node_that_is_to_be_dumped_speaks_udp_alone():
    """Shared memory could not be dumped; the user's own choice stands."""
    assert announcements({}, "movable", udp=True)["FASTDDS_BUILTIN_TRANSPORTS"] == "UDPv4"
    chosen = {"FASTDDS_BUILTIN_TRANSPORTS": "SHM"}
    assert "FASTDDS_BUILTIN_TRANSPORTS" not in announcements(chosen, "movable", udp=True)


@pytest.mark.parametrize(
    "variable", ["FASTRTPS_DEFAULT_PROFILES_FILE", "FASTDDS_DEFAULT_PROFILES_FILE"]
)
def test_what_the_user_has_set_stands(variable):
    """Also afterwards."""
    environment = {variable: "/etc/robot.xml"}
    with announcing(environment, "movable"):
        assert environment == {variable: "/etc/robot.xml"}
    assert environment == {variable: "/etc/robot.xml"}
