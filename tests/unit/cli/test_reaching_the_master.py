"""Where a command looks for the master, and what it says where there is no ROS."""

from __future__ import annotations

import builtins
import os
import sys
import time
from types import SimpleNamespace

import pytest

from rosrm.cli import connection
from rosrm.errors import RosrmError
from rosrm.ros.settings import RosSettings


def test_the_domain_comes_from_before_or_after_the_command(rosrm, client):
    rosrm("--domain", 7, "ps")
    assert client.settings.domain == 7
    rosrm("--domain", 7, "ps", "--domain", 9)
    assert client.settings.domain == 9
    rosrm("ps")
    assert client.settings == RosSettings()


def test_a_cluster_file_says_how_to_join_ros(rosrm, client, tmp_path, monkeypatch):
    (tmp_path / "c.yaml").write_text("ros: {domain: 5, transports: UDPv4}", encoding="utf-8")
    rosrm("--cluster", tmp_path / "c.yaml", "ps")
    assert client.settings == RosSettings(domain=5, transports="UDPv4")
    monkeypatch.setenv("ROSRM_CLUSTER", str(tmp_path / "c.yaml"))
    rosrm("ps", "--domain", 6)
    assert client.settings == RosSettings(domain=6, transports="UDPv4")


def test_a_domain_outside_0_to_232_is_refused(rosrm, client):
    result = rosrm("ps", "--domain", 233)
    assert result.code == 2
    assert "Invalid value for '--domain'" in result.err


@pytest.mark.parametrize(("elapsed", "least", "most"), [(0.2, 2.0, 2.6), (10.0, 1.5, 1.5)])
def test_a_command_looks_for_a_master_until_3_s_after_its_start(monkeypatch, elapsed, least, most):
    seen = {}

    class MasterClient:
        @staticmethod
        def connect(settings, *, name, timeout, joined, begun):
            seen.update(name=name, timeout=timeout)

    module = SimpleNamespace(MasterClient=MasterClient)
    monkeypatch.setitem(sys.modules, "rosrm.ros.client", module)
    monkeypatch.setattr(connection, "BEGUN", time.monotonic() - elapsed)
    connection.connect(RosSettings())
    assert least <= seen["timeout"] <= most
    assert str(os.getpid()) in seen["name"]


def test_without_ros_a_command_says_how_to_get_it(monkeypatch):
    real = builtins.__import__

    def no_ros(name, *more):
        if name == "rosrm.ros.client":
            raise ModuleNotFoundError("No module named 'rclpy'", name="rclpy")
        return real(name, *more)

    monkeypatch.setattr(builtins, "__import__", no_ros)
    with pytest.raises(RosrmError, match=r"ROS 2 cannot be imported.*pip install 'rosrm\[ros\]'"):
        connection.connect(RosSettings())
