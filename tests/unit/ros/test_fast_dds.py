"""Fast DDS settings of the nodes of rosrm."""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree as ET

import pytest

from rosrm.ros.fast_dds import announcements, announcing


def test_fast_dds_is_given_a_profile_while_the_node_is_made():
    """Processes that start later do not inherit the profile."""
    environment = {"HOME": "/home/robot"}
    with announcing(environment, "steady", udp=False):
        (profile,) = set(environment) - {"HOME"}
        text = Path(environment[profile]).read_text()
    assert "heartbeatPeriod" in text
    assert ET.fromstring(text.split("-->", 1)[1]).tag.endswith("profiles")
    assert environment == {"HOME": "/home/robot"}


@pytest.mark.parametrize("pace", ["eager", "steady"])
@pytest.mark.parametrize("chosen", [{}, {"FASTDDS_BUILTIN_TRANSPORTS": "UDPv4"}])
def test_udp_alone_is_chosen_by_transports_and_by_locators(pace, chosen):
    """LOCALHOST replaces the transports, but not the locators; a variable of the user stays."""
    environment = dict(chosen)
    with announcing(environment, pace, udp=True):
        assert environment["FASTDDS_BUILTIN_TRANSPORTS"] == "UDPv4"
        text = Path(environment["FASTRTPS_DEFAULT_PROFILES_FILE"]).read_text()
    assert "<defaultUnicastLocatorList><locator><udpv4/>" in text
    assert environment == chosen


@pytest.mark.parametrize("pace", ["eager", "steady"])
@pytest.mark.parametrize(
    ("udp", "chosen"), [(False, {}), (True, {"FASTDDS_BUILTIN_TRANSPORTS": "SHM"})]
)
def test_no_transport_is_chosen_for_nodes_or_over_the_users_choice(pace, udp, chosen):
    """Large messages may need shared memory."""
    variables = announcements(chosen, pace, udp=udp)
    assert list(variables) == ["FASTRTPS_DEFAULT_PROFILES_FILE"]
    assert "Locator" not in Path(variables["FASTRTPS_DEFAULT_PROFILES_FILE"]).read_text()


@pytest.mark.parametrize("pace", ["eager", "steady"])
def test_the_profile_for_udp_differs_by_its_locators_alone(pace):
    """The two files for one pace must not drift apart."""
    plain, udp = (
        Path(announcements({}, pace, udp=udp)["FASTRTPS_DEFAULT_PROFILES_FILE"])
        .read_text()
        .split("-->", 1)[1]
        .splitlines()
        for udp in (False, True)
    )
    assert [line for line in udp if "defaultUnicastLocatorList" not in line] == plain


@pytest.mark.parametrize(
    "variable", ["FASTRTPS_DEFAULT_PROFILES_FILE", "FASTDDS_DEFAULT_PROFILES_FILE"]
)
def test_what_the_user_has_set_stands(variable):
    """The variable has its value afterwards, too."""
    environment = {variable: "/etc/robot.xml"}
    with announcing(environment, "steady", udp=True):
        assert environment == {variable: "/etc/robot.xml"}
    assert environment == {variable: "/etc/robot.xml"}
