"""Environment of a process on a lab host."""

from __future__ import annotations

from rosrm_lab.host import host_environment


def test_discovery_reaches_the_lab_whatever_the_terminal_says():
    """A caller's restriction to loopback would make discovery inside the lab fail."""
    caller = {
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
        "ROS_LOCALHOST_ONLY": "1",
        "ROS_STATIC_PEERS": "192.168.1.5",
        "ROS_DISCOVERY_SERVER": "192.168.1.5:11811",
    }
    inside = host_environment(caller, "host1")
    assert inside["ROS_AUTOMATIC_DISCOVERY_RANGE"] == "SUBNET"
    assert not {"ROS_LOCALHOST_ONLY", "ROS_STATIC_PEERS", "ROS_DISCOVERY_SERVER"} & set(inside)


def test_only_the_settings_of_a_dds_are_not_handed_on():
    """Such settings may name interfaces, peers or transports that do not exist in a lab."""
    dds = dict.fromkeys(
        ("FASTDDS_BUILTIN_TRANSPORTS", "FASTDDS_DEFAULT_PROFILES_FILE", "FASTDDS_ENVIRONMENT_FILE",
         "FASTRTPS_DEFAULT_PROFILES_FILE", "CYCLONEDDS_URI"), "x",
    )  # fmt: skip
    others = {"PATH": "/opt/bin:/bin", "ROS_DOMAIN_ID": "7", "MINE": "x"}
    inside = host_environment({**dds, **others}, "host1")
    assert others.items() <= inside.items()
    assert not set(dds) & set(inside)


def test_what_is_written_goes_to_the_disk_of_the_host():
    """Snapshots, temporary files and logs are on that disk."""
    inside = host_environment({"ROS_LOG_DIR": "/root/logs", "TMPDIR": "/tmp/x"}, "host1")
    written = [inside[name] for name in ("XDG_STATE_HOME", "TMPDIR", "ROS_HOME")]
    assert written == ["/run/data/state", "/run/data/tmp", "/run/data/ros"]
    assert "ROS_LOG_DIR" not in inside


def test_a_slave_measures_the_host_without_being_told():
    """The variable that gives the default of `scope` selects the host."""
    assert host_environment({}, "host1")["ROSRM_SCOPE"] == "cgroup"
