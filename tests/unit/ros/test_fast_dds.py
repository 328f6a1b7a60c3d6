"""Fast DDS settings of the nodes of rosrm."""

from __future__ import annotations

import socket
from pathlib import Path
from types import SimpleNamespace
from xml.etree import ElementTree as ET

import pytest

from rosrm.errors import ConfigError
from rosrm.ros.fast_dds import LEASE, announcements, announcing, announcing_part, bound
from rosrm.ros.network_interface import check_interface


def test_fast_dds_is_given_a_profile_while_the_node_is_made():
    """Processes that start later do not inherit the profile."""
    environment = {"HOME": "/home/robot"}
    with announcing(environment, "steady", udp=False):
        (profile,) = set(environment) - {"HOME"}
        text = Path(environment[profile]).read_text()
    assert "heartbeatPeriod" in text
    assert "initialAcknackDelay" in text
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
    with announcing(environment, "steady", udp=True), announcing_part(environment, "steady"):
        assert environment == {variable: "/etc/robot.xml"}
    assert environment == {variable: "/etc/robot.xml"}


@pytest.mark.parametrize("pace", ["eager", "steady"])
def test_peers_remove_a_part_of_rosrm_late(pace):
    """A node keeps the default, because the graph shows it for so long after a kill."""
    environment = {}
    with announcing_part(environment, pace):
        path = Path(environment["FASTRTPS_DEFAULT_PROFILES_FILE"])
        profile = path.read_text()
    assert f"<leaseDuration><sec>{LEASE}</sec></leaseDuration>" in profile
    assert ET.fromstring(profile.split("-->", 1)[1]).tag.endswith("profiles")
    assert not path.exists()
    assert environment == {}
    for udp in (False, True):
        of_node = Path(announcements({}, pace, udp=udp)["FASTRTPS_DEFAULT_PROFILES_FILE"])
        assert "leaseDuration" not in of_node.read_text()


# --- one network interface ----------------------------------------------------------------------


@pytest.mark.parametrize("pace", ["eager", "steady"])
@pytest.mark.parametrize("before", [{}, {"FASTRTPS_DEFAULT_PROFILES_FILE": "/etc/robot.xml"}])
def test_a_bound_participant_has_one_transport_with_one_interface(pace, before):
    """The rest of the profile is that of the pace; the user's profile returns afterwards."""
    environment = dict(before)
    with bound(environment, pace, "a<b"):
        path = Path(environment["FASTRTPS_DEFAULT_PROFILES_FILE"])
        profile = ET.fromstring(path.read_text().split("-->", 1)[1])
    assert environment == before
    assert not path.exists()
    names = {"": profile.tag.partition("}")[0][1:]}
    assert [one.text for one in profile.iterfind(".//interfaceWhiteList/address", names)] == ["a<b"]
    chosen = profile.find("participant/rtps/userTransports/transport_id", names)
    made = profile.find("transport_descriptors/transport_descriptor/transport_id", names)
    assert chosen.text == made.text
    assert profile.find("participant/rtps/useBuiltinTransports", names).text == "false"
    assert profile.find(".//initialAnnouncements/count", names).text == "60"
    assert profile.find(".//leaseDuration/sec", names).text == str(LEASE)
    assert profile.find(".//initialAcknackDelay/nanosec", names).text == "1000000"
    writer = profile.find("publisher[@is_default_profile]//heartbeatPeriod", names)
    assert (writer is not None) == (pace == "steady")
    requests = profile.find("publisher[@profile_name='client']//heartbeatPeriod/nanosec", names)
    assert requests.text == "100000000"


@pytest.fixture
def _two_interfaces(monkeypatch):
    address = SimpleNamespace(family=socket.AF_INET, address="10.0.0.1")
    link = SimpleNamespace(family=socket.AF_PACKET, address="00:00:00:00:00:00")
    found = {"wg0": [address], "eth0": [link]}
    monkeypatch.setattr("psutil.net_if_addrs", lambda: found)


@pytest.mark.usefixtures("_two_interfaces")
@pytest.mark.parametrize("interface", ["wg0", "10.0.0.1"])
def test_an_interface_is_given_by_name_or_address(interface):
    """Both are accepted as they are."""
    check_interface(interface)


@pytest.mark.usefixtures("_two_interfaces")
@pytest.mark.parametrize(
    ("interface", "fault"),
    [
        ("wg1", "does not exist on this machine"), ("10.0.0.2", "does not exist on this machine"),
        ("eth0", "has no IPv4 address"),
    ],
)  # fmt: skip
def test_a_wrong_interface_is_refused_with_the_available_ones(interface, fault):
    """The message says where the interface was chosen."""
    with pytest.raises(ConfigError) as refused:
        check_interface(interface)
    assert str(refused.value) == (
        f"the network interface {interface!r} (ros.interface or ROSRM_INTERFACE) {fault}; "
        "available: wg0 (10.0.0.1)"
    )
