"""Setting `ros.interface`, and the settings with which it cannot be combined."""

from __future__ import annotations

import pytest

from rosrm.config.cluster import load_cluster
from rosrm.errors import ConfigError
from rosrm.model.ros_settings import RosSettings


@pytest.fixture(autouse=True)
def _clean(monkeypatch):
    for variable in (
        "ROSRM_INTERFACE", "ROS_AUTOMATIC_DISCOVERY_RANGE", "ROS_LOCALHOST_ONLY",
        "FASTDDS_BUILTIN_TRANSPORTS", "RMW_IMPLEMENTATION",
    ):  # fmt: skip
        monkeypatch.delenv(variable, raising=False)


def test_the_setting_overrides_the_variable(monkeypatch):
    """Commands that the processes run use the same interface."""
    assert RosSettings().interface_in_force() == ""
    monkeypatch.setenv("ROSRM_INTERFACE", "wg0")
    assert RosSettings().interface_in_force() == "wg0"
    chosen = RosSettings(interface="eth1")
    assert chosen.interface_in_force() == "eth1"
    assert chosen.environment() == {"ROSRM_INTERFACE": "eth1"}
    assert chosen.describe().endswith(", interface eth1")


@pytest.mark.parametrize("text", ["wg 0", "a/b", "a-name-of-16-byt", "::1"])
def test_a_text_that_names_no_interface_is_refused(refusal, text):
    """Linux has names of up to 15 bytes; the profile is for IPv4."""
    said = refusal(load_cluster, f"ros: {{interface: '{text}'}}")
    assert "no name or IPv4 address of an interface" in said


@pytest.mark.parametrize(
    ("settings", "environment", "conflict"),
    [
        ({"discovery_range": "localhost"}, {}, "discovery.range: localhost"),
        ({}, {"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}, "discovery.range: localhost"),
        ({}, {"ROS_LOCALHOST_ONLY": "1"}, "ROS_LOCALHOST_ONLY=1"),
        ({"transports": "SHM"}, {}, "transports other than UDPv4"),
        ({}, {"FASTDDS_BUILTIN_TRANSPORTS": "LARGE_DATA"}, "transports other than UDPv4"),
        (
            {},
            {"RMW_IMPLEMENTATION": "rmw_cyclonedds_cpp"},
            "RMW_IMPLEMENTATION=rmw_cyclonedds_cpp;",
        ),
    ],
)
def test_a_setting_that_would_make_fast_dds_ignore_the_interface_is_refused(
    monkeypatch, settings, environment, conflict
):
    """An interface that is ignored would open the part to all networks."""
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    RosSettings(**settings).check()
    with pytest.raises(ConfigError, match=f"the interface 'wg0'.* with {conflict}"):
        RosSettings(interface="wg0", **settings).check()


@pytest.mark.parametrize(
    "settings",
    [
        {"discovery_range": "subnet", "transports": "UDPv4"}, {"discovery_server": "a:11811"},
        {},
    ],
)  # fmt: skip
def test_other_settings_may_be_combined_with_it(settings):
    """UDP over one interface, with multicast or a discovery server."""
    RosSettings(interface="wg0", **settings).check()
