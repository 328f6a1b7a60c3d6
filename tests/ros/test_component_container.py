"""`rosrm container`: components in Python share a process, by the services of ROS 2."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from std_msgs.msg import String

from rosrm import clocks
from rosrm.model.ros_settings import RosSettings
from rosrm.ros.participant import Participant
from rosrm.testing.local_cluster import claim_domain
from tests.ros.calls import answer_to
from tests.waiting import PATIENCE, wait_until

srv = pytest.importorskip("composition_interfaces.srv")

ROOT = Path(__file__).resolve().parents[2]
COMPONENTS = "tests.ros.programs.components"


class Loader:
    """A container, and a client of its services."""

    def __init__(self, participant: Participant, domain: int) -> None:
        self.participant = participant
        # A container answers a new client only once it has discovered it.
        self.clients: dict[str, Any] = {}
        arguments = ["--ros-args", "-r", "__ns:=/arm"]
        self.process = subprocess.Popen(
            [sys.executable, "-m", "rosrm.cli", "container", *arguments], cwd=ROOT,
            env={**os.environ, "ROS_DOMAIN_ID": str(domain)}, stderr=subprocess.PIPE, text=True,
        )  # fmt: skip

    def ask(self, kind: str, service: str, **fields: Any) -> Any:
        """Return the answer of the container to a request."""
        of = getattr(srv, kind)
        if service not in self.clients:
            path = f"/arm/container/_container/{service}"
            self.clients[service] = self.participant.node.create_client(of, path)
        client = self.clients[service]
        assert client.wait_for_service(PATIENCE), f"{service} is not offered"
        future = client.call_async(of.Request(**fields))
        return answer_to(self.participant, future, clocks.boot_time() + PATIENCE)

    def load(self, component: str, **fields: Any) -> Any:
        return self.ask("LoadNode", "load_node", plugin_name=f"{COMPONENTS}:{component}", **fields)

    def names(self) -> list[str]:
        return list(self.ask("ListNodes", "list_nodes").full_node_names)


@pytest.fixture(scope="module")
def loader() -> Iterator[Loader]:
    """Start a container in the namespace /arm."""
    domain, claim = claim_domain()
    with claim, Participant(RosSettings(domain), "loader") as participant:
        one = Loader(participant, domain)
        yield one
        one.process.kill()
        one.process.wait()


def test_components_are_loaded_listed_and_unloaded(loader: Loader) -> None:
    """Names, namespaces, parameters and remappings are those of the request."""
    from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue

    value = ParameterValue(type=ParameterType.PARAMETER_STRING, string_value="hello")
    heard: list[str] = []
    loader.participant.node.create_subscription(
        String, "/left/remapped", lambda message: heard.append(message.data), 10
    )
    left = loader.load(
        "Talker", node_name="left", node_namespace="/left", remap_rules=["words:=remapped"],
        parameters=[Parameter(name="says", value=value)],
    )  # fmt: skip
    right = loader.load("Talker", node_namespace="/right")
    assert (left.success, left.full_node_name, left.error_message) == (True, "/left/left", "")
    assert loader.names() == ["/left/left", "/right/talker"]
    wait_until(lambda: loader.participant.spin(0.05) or heard, "a message of the component")
    assert heard[0] == "hello"

    gone = loader.ask("UnloadNode", "unload_node", unique_id=left.unique_id)
    assert (gone.success, gone.error_message) == (True, "")
    assert loader.names() == ["/right/talker"]
    loader.ask("UnloadNode", "unload_node", unique_id=right.unique_id)
    again = loader.ask("UnloadNode", "unload_node", unique_id=right.unique_id)
    assert again.error_message == f"no component {right.unique_id}; loaded: none"


@pytest.mark.parametrize(
    ("fields", "why"),
    [
        ({"plugin_name": f"{COMPONENTS}:Broken"}, "OSError: no device here"),
        ({"plugin_name": f"{COMPONENTS}:Absent"}, f"{COMPONENTS} has no class Absent"),
        ({"plugin_name": f"{COMPONENTS}:Plain"}, "it makes a Plain, not a node of rclpy"),
        ({"plugin_name": "absent.module:A"}, "No module named 'absent'"),
        (
            {"package_name": "arms", "plugin_name": "Arm"},
            "'Arm' of the package arms",
        ),
    ],
)
def test_a_component_that_cannot_be_loaded_is_refused_with_the_reason(
    loader: Loader, fields: dict[str, str], why: str
) -> None:
    """The container and its other components run on."""
    before = loader.names()
    refused = loader.ask("LoadNode", "load_node", **fields)
    assert not refused.success
    assert why in refused.error_message
    assert loader.names() == before


def test_a_node_whose_constructor_raises_leaves_the_graph(loader: Loader) -> None:
    """A second try would otherwise find a node of the same name."""
    refused = loader.load("Half", node_name="half")
    assert "OSError: no device here" in refused.error_message
    later = loader.load("Talker", node_name="later")
    names = loader.participant.node.get_node_names
    wait_until(lambda: "later" in names(), "the node that was loaded after it is in the graph")
    assert "half" not in names()
    loader.ask("UnloadNode", "unload_node", unique_id=later.unique_id)


def test_a_second_component_of_one_name_is_refused(loader: Loader) -> None:
    """Two nodes of one name would disturb each other."""
    first = loader.load("Talker", node_name="one")
    second = loader.load("Talker", node_name="one")
    assert "a component /one is loaded already" in second.error_message
    loader.ask("UnloadNode", "unload_node", unique_id=first.unique_id)


def test_a_signal_ends_a_container(loader: Loader) -> None:
    """SIGINT is a usual end, without a traceback."""
    loader.load("Talker")
    loader.process.send_signal(signal.SIGINT)
    assert loader.process.wait(PATIENCE) == 0
    assert loader.process.stderr is not None
    assert "Traceback" not in loader.process.stderr.read()
