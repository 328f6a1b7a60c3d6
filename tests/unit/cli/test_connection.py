"""Connection of commands to the master: domain, early join, and errors without ROS."""

from __future__ import annotations

import builtins
import os
import re
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
from typer.main import get_command

from rosrm import clocks
from rosrm.cli import connection, early
from rosrm.cli.command_tree import app
from rosrm.errors import NoMaster, RosrmError, ros_needed
from rosrm.keys.roles import Principal
from rosrm.keys.security import NoSecurity
from rosrm.model.ros_settings import RosSettings
from rosrm.ros import master_connection


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
        def connect(settings, *, name, timeout, security, joined, begun):
            seen.update(name=name, timeout=timeout)

    module = SimpleNamespace(MasterClient=MasterClient)
    monkeypatch.setitem(sys.modules, "rosrm.ros.master_connection", module)
    monkeypatch.setattr(connection, "BEGUN", clocks.boot_time() - elapsed)
    connection.connect(RosSettings())
    assert least <= seen["timeout"] <= most
    assert str(os.getpid()) in seen["name"]


# --- before the command line is parsed ---------------------------------------------------------


def test_each_command_that_asks_the_master_joins_ros_early():
    """All commands with a domain do, except the parts of rosrm, which search again and again."""
    tree = get_command(app).commands
    asking = {
        name for name, command in tree.items()
        if any(option.name == "domain" for option in command.params)
    }  # fmt: skip
    assert asking - {"up", "master", "slave", "collect-logs"} == early.ASKING


@pytest.fixture
def joined(monkeypatch):
    """Record creation and close of participants that were made early."""
    became = []

    class Participant:
        def __init__(self, settings, name):
            self.settings = settings
            became.append("made")

        def close(self):
            became.append("closed")

    monkeypatch.setattr(early, "_SOCKETS", Path(os.devnull))
    module = SimpleNamespace(Participant=Participant)
    monkeypatch.setitem(sys.modules, "rosrm.ros.participant", module)
    yield became
    early.drop()


@pytest.mark.parametrize(
    ("line", "environment", "joins"),
    [
        (["ps", "--json"], {}, True),
        (["events", "--host", "h"], {}, True),
        (["ps", "-h"], {}, False),
        (["ps", "--domain=3"], {}, False),
        (["plugins", "--local"], {}, False),
        (["--cluster", "c.yaml", "ps"], {}, False),
        (["ps"], {"ROSRM_CLUSTER": "c.yaml"}, False),
        (["config", "check", "ps"], {}, False),
        ([], {}, False),
    ],
)
def test_ros_is_joined_early_only_where_it_is_sure_how(joined, line, environment, joins):
    """An option or a file may change the join, or make it unnecessary."""
    early.join(line, environment)
    assert joined == ["made"] * joins


@pytest.mark.parametrize(("domain", "command", "joins"), [(3, "ps", False), (3, "logs", True),
                                                       (30, "ps", True)])  # fmt: skip
def test_ros_is_not_joined_early_where_the_master_has_a_socket(
    joined, monkeypatch, tmp_path, domain, command, joins
):
    """Logs are read from slaves over DDS."""
    sockets = tmp_path / "unix"
    sockets.write_text("Num  Path\n0000: 00000002 0 00010000 0001 01 17 @rosrm/3/0f0f\n")
    monkeypatch.setattr(early, "_SOCKETS", sockets)
    monkeypatch.setenv("ROS_DOMAIN_ID", str(domain))
    early.join([command], {})
    assert joined == ["made"] * joins


def test_a_participant_is_handed_over_or_closed(joined):
    """A connection with the same settings takes it; otherwise it is closed at its end."""
    early.join(["ps"], {})
    assert early.take(RosSettings(domain=7)) is None
    early.drop()
    assert joined == ["made", "closed"]
    early.join(["ps"], {})
    assert early.take(RosSettings()) is not None
    assert early.take(RosSettings()) is None
    early.drop()
    assert joined == ["made", "closed", "made"]


def test_a_fault_of_ros_is_left_to_the_connection(monkeypatch):
    """The connection meets the error again and reports it."""
    monkeypatch.setitem(sys.modules, "rosrm.ros.participant", None)
    early.join(["ps"], {})
    assert early.take(RosSettings()) is None


@pytest.mark.parametrize("server", ["", "desk:11811"])
def test_without_a_master_the_discovery_server_is_asked_after(monkeypatch, server):
    """The time counts from the beginning of the user's wait."""
    settings = RosSettings(domain=3, discovery_server=server)
    closed = []
    participant = SimpleNamespace(settings=settings, close=lambda: closed.append(True))
    monkeypatch.delenv("ROS_DISCOVERY_SERVER", raising=False)
    monkeypatch.setattr(master_connection.MasterClient, "_client", lambda *_: None)
    monkeypatch.setattr(master_connection, "wait_for_service", lambda *_: False)
    endpoints = SimpleNamespace(participant=participant)  # without the import of ROS
    monkeypatch.setattr(master_connection, "SealedEndpoints", lambda *_: endpoints)
    monkeypatch.setattr(master_connection, "user_security", lambda *_: NoSecurity())
    with pytest.raises(NoMaster) as refusal:
        master_connection.MasterClient.connect(
            settings, name="x", timeout=1.6, joined=participant, begun=clocks.boot_time() - 3.0
        )
    assert re.search(r"no master answered within 3\.\d s", str(refusal.value))
    assert ("Is the discovery server at desk:11811 running" in str(refusal.value)) == bool(server)
    assert "`rosrm master` running there" in str(refusal.value)
    assert closed


def test_commands_do_not_load_the_generator_of_messages():
    """The generator costs 60 ms, and only builds of interfaces use it."""
    code = (
        "import sys; import rosrm.ros.master_connection; from rosrm_msgs import srv\n"
        "srv.List.__class__.__import_type_support__.__get__(srv.List)()\n"
        "print('em' in sys.modules, 'rosidl_generator_py' in sys.modules)"
    )
    said = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=True
    )
    assert said.stdout.split() == ["False", "True"], said.stderr


def test_without_ros_a_command_says_how_to_get_it(monkeypatch):
    real = builtins.__import__

    def no_ros(name, *more):
        if name == "rosrm.ros.master_connection":
            raise ModuleNotFoundError("No module named 'rclpy'", name="rclpy")
        return real(name, *more)

    monkeypatch.setattr(builtins, "__import__", no_ros)
    with pytest.raises(RosrmError, match=r"ROS 2 cannot be imported.*pip install 'rosrm\[ros\]'"):
        connection.connect(RosSettings())


@pytest.mark.parametrize("words", [("master",), ("slave",), ("up",), ("run", "--", "id"), ("ps",)])
def test_ros_that_cannot_be_loaded_is_an_error_without_a_traceback(tmp_path, words):
    """A wrong LD_LIBRARY_PATH, for example; also where a command needs ROS only later."""
    (tmp_path / "rclpy").mkdir()
    text = 'raise ImportError("librcl.so: cannot open shared object file", name="_rclpy")'
    (tmp_path / "rclpy" / "__init__.py").write_text(text, encoding="utf-8")
    done = subprocess.run(
        [sys.executable, "-m", "rosrm.cli", *words], capture_output=True, text=True, timeout=60,
        env=os.environ | {"PYTHONPATH": str(tmp_path), "ROSRM_KEYS": str(tmp_path / "keys"),
                          "XDG_STATE_HOME": str(tmp_path), "ROSRM_SECURITY": "none"}, check=False,
    )  # fmt: skip
    assert done.returncode == 1
    last = done.stderr.splitlines()[-1]
    assert re.match(r"rosrm[ a-z]*: ROS 2 cannot be imported \(librcl\.so: cannot open", last)
    assert "Traceback" not in done.stderr


def test_an_endpoint_that_is_made_later_names_ros_too(monkeypatch):
    """A client on the master's machine joins ROS only for the logs of a slave."""
    real = builtins.__import__

    def no_ros(name, *more):
        if name == "rosrm.ros.participant":
            raise ImportError("librcl.so: cannot open shared object file")
        return real(name, *more)

    security = NoSecurity(Principal("user", "ada"))
    client = master_connection.MasterClient(RosSettings(), security, "test", 1.0, None)
    monkeypatch.setattr(builtins, "__import__", no_ros)
    with pytest.raises(RosrmError, match=r"ROS 2 cannot be imported \(librcl"):
        _ = client._endpoints


def test_another_import_that_fails_is_no_fault_of_ros():
    """Its traceback leads to the cause."""
    with pytest.raises(ImportError, match="no aiohttp"), ros_needed():
        raise ImportError("no aiohttp", name="aiohttp")


@pytest.mark.parametrize("word", ["abc", "300", "-1", "1.5"])
def test_a_domain_of_the_environment_is_checked_before_ros_is_joined(monkeypatch, rosrm, word):
    """The bounds of --domain, which overrides the variable, hold for all commands."""
    monkeypatch.setenv("ROS_DOMAIN_ID", word)
    for command in ("ps", "master", "slave"):
        early.join([command], {})
        result = rosrm(command)
        assert (result.code, result.out) == (2, "")
        assert result.err == (
            f"rosrm: ROS_DOMAIN_ID={word!r} is not a whole number from 0 to 232; set the variable "
            f"to one, or give --domain N\n"
        )
    RosSettings(domain=3).check()


def test_an_interface_that_does_not_exist_is_refused_before_a_part_starts(rosrm, monkeypatch):
    """The error is the command's, and not that of the runtime that replaces it."""
    monkeypatch.setenv("ROSRM_INTERFACE", "no-such-link")
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "SUBNET")
    for command in ("master", "slave"):
        result = rosrm(command)
        assert (result.code, result.out) == (2, "")
        assert result.err.startswith("rosrm: the network interface 'no-such-link' (ros.interface")
        assert "lo (127.0.0.1)" in result.err.partition("; available: ")[2]
