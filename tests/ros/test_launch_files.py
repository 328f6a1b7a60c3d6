"""Translated launch files on two hosts: the stored models run as applications."""

from __future__ import annotations

import json
import os
import signal
import sys
from pathlib import Path

import pytest

from rosrm.config.work import checked_work
from rosrm.extensions.registry import Registry
from rosrm_launch.beside import completed
from rosrm_launch.model import LaunchModel, Parameters, Process
from rosrm_launch.translate import translated
from tests.launch_files import make_package, stored
from tests.ros.clusters import NODE, SPIN, host

#: The node of these files, which is a lifecycle node where a file makes its transitions.
LIFECYCLE_NODE = NODE.replace(
    "from rclpy.node import Node", "from rclpy.lifecycle import LifecycleNode as Node"
)


@pytest.fixture(scope="module")
def package(tmp_path_factory):
    """Return the prefix of the package of the launch files, with a real node in it."""
    prefix = tmp_path_factory.mktemp("install")
    make_package(prefix, LIFECYCLE_NODE)
    return prefix


@pytest.fixture(scope="module")
def cluster(make_shared, package):
    """Return a cluster of which only the second host has the package."""
    with pytest.MonkeyPatch.context() as patch:
        made = make_shared(host("bare"))
        patch.setenv("AMENT_PREFIX_PATH", str(package))
        made.add(host("robot", labels={"has": "robot"}))
    return made


def target_of(name: str, beside: Path | None = None):
    path = Path("/robot", name)
    work = completed(translated(LaunchModel.model_validate(stored(name))), path, beside)
    return checked_work(work, path, None)


#: A program with three nodes, of which the last two have names of their own, as in Nav2.
SEVERAL_NODES = (
    """
import json, rclpy
from rclpy.node import Node
rclpy.init()
own = [[], *(["--ros-args", "-r", f"__node:={name}", "-r", f"__ns:={namespace}"]
       for name, namespace in (("costmap", "/costmap"), ("helper", "/")))]
nodes = [
    Node("x", cli_args=words, automatically_declare_parameters_from_overrides=True) for words in own
]
node = nodes[0]
print(json.dumps({
    one.get_fully_qualified_name(): {
        name: one.get_parameter(name).value for name in one._parameters
        if not name.startswith(("use_sim", "start_"))
    }
    for one in nodes
}), flush=True)
"""
    + SPIN
)
#: What launch gives such a program: files, and a dictionary between them.
SECTIONS = [
    Parameters(values={"frame": "map", "plugins": ["a", "b"]}),
    Parameters(nodes="/controller", values={"rate": 20.0, "goal.x": 1.0}),
    Parameters(nodes="/costmap/costmap", values={"width": 3, "frame": "odom"}),
    Parameters(nodes="/controller", values={"rate": 30.0}),
    Parameters(nodes="/costmap/costmap", values={"width": 4}),
    Parameters(values={"plugins": ["c"]}),
]


def test_each_node_of_a_process_gets_its_section_on_every_host(cluster, tmp_path) -> None:
    """The files name the node in full or by `/**`; their order decides, also after a move."""
    program = tmp_path / "several.py"
    program.write_text(SEVERAL_NODES)
    process = Process(
        number=0, kind="node", file="nav.launch.py", name="controller",
        command=[sys.executable, str(program)], parameters=SECTIONS,
    )  # fmt: skip
    beside = tmp_path / "nav.rosrm.yaml"
    beside.write_text("nodes: {controller: {migration: relaunch}}\n")
    path = Path("/robot/nav.launch.py")
    model = LaunchModel(file=str(path), processes=[process])
    target = checked_work(completed(translated(model), path, beside), path, Registry.discover())
    cluster.client.apply([target])
    first = cluster.wait("controller", "running").host
    expected = {
        "/controller": {"frame": "map", "plugins": ["c"], "rate": 30.0, "goal.x": 1.0},
        "/costmap/costmap": {"frame": "odom", "plugins": ["c"], "width": 4},
        "/helper": {"frame": "map", "plugins": ["c"]},
    }
    assert json.loads(line_of(cluster, "controller")) == expected
    cluster.client.migrate("controller", None)
    cluster.wait("controller", "running", where=lambda row: row.host != first)
    assert json.loads(line_of(cluster, "controller")) == expected
    remove(cluster, target)


def line_of(cluster, name: str) -> str:
    cluster.wait_for_log(name, "}\n")
    return next(line for line in cluster.log(name).splitlines() if line.startswith("{"))


def said(cluster, name: str) -> dict:
    return json.loads(line_of(cluster, name))


def remove(cluster, target) -> None:
    cluster.cancel(*(spec.name for spec in target.specs))


def test_the_nodes_of_a_launch_file_run_where_their_package_is(cluster, package, tmp_path) -> None:
    """Names, namespaces, parameters, remappings and paths reach the nodes as from launch."""
    beside = tmp_path / "talkers.rosrm.yaml"
    beside.write_text("nodes: {pause: {labels: {avoided: {has: robot}}}}\n")
    target = target_of("talkers.launch.py", beside)
    cluster.client.apply([target])
    rows = {spec.name: cluster.wait(spec.name, "running") for spec in target.specs}
    assert rows.pop("pause").host == "bare"
    assert {row.host for row in rows.values()} == {"robot"}
    driver = said(cluster, "left.driver")
    assert (driver["name"], driver["topic"]) == ("/left/driver", "/chatter")
    assert driver["parameters"]["map"] == f"{package}/share/demo_robot/maps/hall.yaml"
    assert driver["parameters"]["rate"] == 2.5
    assert said(cluster, "right.driver")["name"] == "/right/driver"
    assert said(cluster, "tools.monitor")["parameters"]["label"] == "included"
    remove(cluster, target)


def test_events_and_timers_of_a_launch_file(cluster) -> None:
    """A node starts after the end of its spawner, another after that one; one end ends all."""
    target = target_of("events.launch.py")
    cluster.client.apply([target])
    for name in ("last", "late", "follower", "shell"):
        cluster.wait(name, "running")
    assert cluster.process("spawner").state == "finished"
    os.kill(cluster.process("main").pid, signal.SIGKILL)
    ends = {spec.name: cluster.ended(spec.name).state for spec in target.specs}
    assert (ends.pop("main"), ends.pop("spawner")) == ("failed", "finished")
    assert set(ends.values()) == {"cancelled"}


@pytest.mark.parametrize("name", ["sensors.launch.xml", "tools.launch.yaml", "lifecycle.launch.py"])
def test_the_processes_of_each_other_file_run(cluster, name) -> None:
    """XML, YAML, and lifecycle nodes in the required states."""
    target = target_of(name)
    cluster.client.apply([target])
    for spec in target.specs:
        cluster.wait(spec.name, "running")
    remove(cluster, target)


def test_what_no_host_has_is_the_reason_of_the_failure(cluster, tmp_path) -> None:
    """A package that is nowhere, and an executable that the host of its process lacks."""
    model = LaunchModel.model_validate(stored("tools.launch.yaml"))
    node = model.processes[0]
    absent = node.model_copy(update={"name": "absent", "package": "nowhere"})
    wrong = node.model_copy(update={"number": 1, "name": "wrong", "executable": "talkr"})
    model = model.model_copy(update={"processes": [absent, wrong]})
    beside = tmp_path / "faulty.rosrm.yaml"
    beside.write_text("nodes: {tools.wrong: {labels: {required: {has: robot}}}}\n")
    path = Path("/robot/faulty.launch.yaml")
    work = completed(translated(model, "faulty"), path, beside)
    cluster.client.apply([checked_work(work, path, None)])
    everywhere = cluster.wait_for_event("failed", process="tools.absent").message
    assert "bare: the ROS package 'nowhere' was not found" in everywhere
    assert "robot: the ROS package 'nowhere' was not found" in everywhere
    there = cluster.wait_for_event("failed", process="tools.wrong").message
    assert "bare lacks the label has=robot" in there
    assert "robot: the package 'demo_robot' has no executable 'talkr'" in there
    assert "did you mean talker?" in there


def test_the_components_of_a_launch_file_are_loaded_into_their_container(cluster) -> None:
    """The ROS wheels have no components in C++, so rosrm's container takes their place."""
    pytest.importorskip("composition_interfaces")
    model = json.dumps(stored("components.launch.xml"))
    for plugin in ("demo::A", "demo::B"):
        model = model.replace(plugin, "tests.ros.programs.components:Talker")
    path = Path("/robot/components.launch.xml")
    translation = translated(LaunchModel.model_validate_json(model))
    container = translation.work["processes"][0]
    del container["package"], container["executable"]
    container |= {"module": "rosrm.node.container", "ros": True}
    container["environment"] = {"PYTHONPATH": str(Path(__file__).parents[2])}
    target = checked_work(completed(translation, path, None), path, None)
    cluster.client.apply([target])
    cluster.wait("pool", "running")
    assert "/a says nothing" in cluster.log("pool")
    assert "/x/b says nothing" in cluster.log("pool")
    remove(cluster, target)
