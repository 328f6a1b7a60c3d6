"""Translation of resolved launch files into applications; the models come from a real `launch`."""

from __future__ import annotations

from pathlib import Path

import pytest

from rosrm.config.work import checked_work
from rosrm.errors import ConfigError
from rosrm.model.values import (
    GroupMembership,
    Kind,
    RestartPolicy,
    StartOrder,
    StopPolicy,
    qualified_name,
)
from rosrm.slave.launch.parameter_files import all_parameters
from rosrm_launch.beside import completed
from rosrm_launch.model import Component, LaunchModel, Load, Parameters, Process, Transition, Wait
from rosrm_launch.translate import translated
from tests.launch_files import CASES, stored

ROOT = Path(__file__).resolve().parents[4]


def translation_of(name):
    return translated(LaunchModel.model_validate(stored(name)))


def specs_of(name):
    """Return the specs of a stored model by name, as a master would get them."""
    path = Path("/robot", name)
    work = completed(translation_of(name), path, None)
    return {spec.name: spec for spec in checked_work(work, path, None).specs}


def parameters_of(spec):
    """Return the parameters that the node of a process gets on its host."""
    sections = all_parameters(spec)
    return sections.get(qualified_name(spec.namespace, spec.node), sections.get("/**", {}))


def made(*processes: Process, **others):
    return translated(LaunchModel(file="/x/robot.launch.py", processes=list(processes), **others))


def node(number: int, name: str = "", **fields) -> Process:
    return Process(
        number=number, kind=fields.pop("kind", "node"), file="/x/robot.launch.py", name=name,
        package="p", executable="e", **fields,
    )  # fmt: skip


@pytest.mark.parametrize("name", CASES)
def test_each_file_becomes_an_application_without_faults(name):
    """The work file passes all checks, and has the name of the launch file."""
    specs = specs_of(name)
    assert {spec.application for spec in specs.values()} == {name.partition(".")[0]}
    assert len(specs) == len(stored(name)["processes"])


def test_arguments_conditions_groups_and_includes():
    """Nodes of one name in two namespaces; parameters, remappings and paths are those of launch."""
    specs = specs_of("talkers.launch.py")
    assert list(specs) == [
        "talker_0", "left.driver", "right.driver", "right.real", "sensors.lidar", "tools.monitor",
        "pause",
    ]  # fmt: skip
    left, right = specs["left.driver"], specs["right.driver"]
    assert (left.node, left.namespace, right.node, right.namespace) == (
        "driver", "/left", "driver", "/right",
    )  # fmt: skip
    there = "$(find-pkg-share demo_robot)/maps/hall.yaml"
    assert left.arguments == ("--config", there)
    assert parameters_of(left) == {
        "use_sim_time": False, "rate": 2.5, "tolerance": 0.001, "words": ["a", "b"],
        "gains": [1.0, 2.0], "map": there,
    }  # fmt: skip
    assert left.remappings == {"chatter": "/chatter", "image": "image_raw"}
    assert (left.environment, right.environment) == ({"SIDE": "left"}, {"LEVEL": "7"})
    assert right.prefix == ("nice", "-n", "5")
    assert left.restart.when == "never"


def test_parameters_of_a_full_name_override_those_of_a_pattern():
    """As launch_ros does, also if the pattern is in a later file."""
    lidar = specs_of("sensors.launch.xml")["sensors.lidar"]
    assert parameters_of(lidar)["rate"] == 8.0
    assert parameters_of(lidar)["nested.flag"] is True
    assert (lidar.restart.when, lidar.restart.delay) == ("always", 1.5)


def test_a_variable_with_a_dollar_sign_stays_as_it_is():
    """A `$` is kept, because launch does not pass variables through a shell either."""
    (entry,) = made(node(0, "a", environment={"A": "$B", "C": "d"}, prefix=["nice"])).work[
        "processes"
    ]
    assert (entry["prefix"], entry["environment"]) == (["env", "A=$B", "nice"], {"C": "d"})


def test_a_process_gets_the_sections_of_all_nodes():
    """Its program may have further nodes, such as the costmap of a controller of Nav2."""
    given = [
        Parameters(nodes="/controller", values={"rate": 20}),
        Parameters(nodes="/costmap/costmap", values={"width": 3}),
        Parameters(values={"use_sim_time": True}),
    ]
    (entry,) = made(node(0, "controller", parameters=given)).work["processes"]
    sections = {
        nodes: it["ros__parameters"] for one in entry["parameters"] for nodes, it in one.items()
    }
    assert list(sections.items()) == [
        ("/**", {"use_sim_time": True}), ("/controller", {"rate": 20}),
        ("/costmap/costmap", {"width": 3}),
    ]  # fmt: skip


def test_events_become_a_start_order_and_a_group():
    """A process whose end starts another one is a job; `Shutdown` at an end cancels the others."""
    specs = specs_of("events.launch.py")
    assert specs["spawner"].kind is Kind.JOB
    assert specs["shell"].command == ("sh", "-c", "echo $HOME ; sleep 1000")
    assert specs["follower"].start_order == StartOrder({"spawner": "finished"})
    assert specs["last"].start_order == StartOrder({"follower": "ready"}, 0.5)
    assert specs["last"].restart == RestartPolicy("always", 0.0, 0.0, 1.0, 3)
    assert specs["last"].stop == StopPolicy(2.0, 5.0)
    assert specs["late"].start_order == StartOrder({"main": "ready", "shell": "ready"}, 1.0)
    assert specs["main"].group == GroupMembership("events", "always")
    assert specs["late"].group == GroupMembership("events", "never")


def test_a_process_whose_end_ends_all_is_not_restarted():
    """In launch the shutdown comes before the respawn."""
    (entry,) = made(node(0, "a", respawn=True, ends_all=True)).work["processes"]
    assert entry["restart"] == "never"


def test_groups_have_an_environment_and_parameters_of_their_own():
    """A group without forwarding begins with the environment and settings of the shell."""
    specs = specs_of("scopes.launch.py")
    grouped, bare = specs["arm.grouped"], specs["bare"]
    assert grouped.environment == {
        "DEMO_MODE": "plain", "DEMO_PATH": "/opt:/usr/share", "ROS_LOG_DIR": "/tmp",
    }  # fmt: skip
    assert grouped.prefix == ("env", "-u", "DEMO_GONE", "nice", "-n", "3")
    assert parameters_of(grouped) == {"speed": 3, "rate": 1.0, "tolerance": 0.001}
    assert grouped.remappings == {"chatter": "/chatter"}
    assert (bare.environment, bare.prefix, parameters_of(bare)) == ({}, (), {})


def test_options_of_processes():
    """Arguments for ROS follow those of the program; `exec_name` names a process without a node."""
    specs = specs_of("scopes.launch.py")
    options, labelled = specs["options"], specs["labelled"]
    assert options.arguments == ("-v", "--ros-args", "--log-level", "debug")
    assert options.environment == {"DEMO_EXTRA": "1"}
    assert options.stop == StopPolicy(7.0, 8.0)
    assert labelled.executable == "talker"
    assert labelled.environment == {"DEMO_MODE": "plain", "DEMO_LATE": "1"}
    assert specs["alone"].environment == {"DEMO_ONLY": "1"}


def test_handlers_of_python_code_and_of_a_complete_execution():
    """Both wait for the end of the process."""
    specs = specs_of("scopes.launch.py")
    assert specs["completed"].start_order == StartOrder({"first": "finished"})
    assert specs["registered"].start_order == StartOrder({"first": "finished"})
    assert specs["first"].kind is Kind.JOB


def test_transitions_become_the_state_to_which_a_host_brings_a_node():
    """A node that the file only configures is inactive; what waits for a state waits for ready."""
    specs = specs_of("lifecycle.launch.py")
    found = {name: spec.lifecycle.autostart for name, spec in specs.items()}
    assert found == {
        "robot.driver": "active", "maps": "inactive", "robot.waiting": "unmanaged",
        "plain": "unmanaged", "planner": "unmanaged",
    }  # fmt: skip
    assert specs["planner"].start_order == StartOrder({"robot.driver": "ready"})


def test_transitions_of_unknown_nodes_are_listed():
    """Another launch file may start them."""
    changes = [
        Transition(file="/x/robot.launch.py", nodes=nodes, transition=name)
        for nodes, name in ((["/a", "b"], "autostart"), ([], "activate"), (["/a"], "cleanup"))
    ]
    made_of_two = made(node(0, "b"), node(1), transitions=changes)
    assert made_of_two.work["processes"][0]["lifecycle"] == "active"
    assert [(one.action, one.reason) for one in made_of_two.omissions] == [
        ("transition autostart of /a", "the file starts no such node"),
        ("transition activate of no node", "the file starts no such node"),
        ("transition cleanup of /a", "a host makes no such transition"),
    ]


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("events.launch.py", ["OnProcessIO", "OnProcessExit", "OnShutdown", "EmitEvent"]),
        (
            "scopes.launch.py",
            ["SetROSLogDir", "environment of alone", "OnProcessStart", "Node told"],
        ),
        ("lifecycle.launch.py", ["OnStateTransition", "transition inactive_shutdown of /maps"]),
        ("components.launch.py", ["component demo::Unnamed of /camera/pipeline"]),
        ("components.launch.xml", []),
        ("talkers.launch.py", []),
    ],
)  # fmt: skip
def test_what_has_no_counterpart_is_listed_with_its_file(name, said):
    """Components without a name and other transitions are listed, and their processes run."""
    omissions = translation_of(name).omissions
    assert [one.action for one in omissions] == said
    assert all(one.file.endswith(f"demo_robot/launch/{name}") for one in omissions)


def test_components_are_those_of_their_container_in_order():
    """First those that the container names, then those that are loaded into it by its name."""
    pipeline, _ = translation_of("components.launch.py").work["processes"]
    camera = {
        "package": "demo_parts", "plugin": "demo::Camera", "name": "source",
        "namespace": "/camera", "remappings": {"image": "raw"},
        "parameters": {
            "rate": 1.0, "offset": [0.5, 1.0], "tolerance": "1e-3",
            "map": "$(find-pkg-share demo_robot)/maps/hall.yaml",
        },
        "arguments": {"use_intra_process_comms": True},
    }  # fmt: skip
    filtering = {"package": "demo_parts", "plugin": "demo::Filter", "name": "filter"}
    assert pipeline["components"] == [camera, {**filtering, "namespace": "/camera"}]
    pool, _ = translation_of("components.launch.xml").work["processes"]
    assert [one["name"] for one in pool["components"]] == ["a", "b"]


def test_a_container_may_be_a_plain_node():
    """The launch file of Nav2 starts it so, and loads all components by its name."""
    part = Component(package="p", plugin="q", name="map")
    work = made(node(0, "c"), loads=[Load(file="f", container="c", components=[part])]).work
    assert work["processes"][0]["components"] == [{"package": "p", "plugin": "q", "name": "map"}]


def test_components_of_a_container_that_the_file_does_not_start_are_listed():
    """Another application has the container, or launch would wait for it without end."""
    load = Load(file="f", container="other", components=[Component(package="p", plugin="q")])
    omissions = made(node(0, "c", kind="container"), loads=[load]).omissions
    assert [(one.action, one.reason) for one in omissions] == [
        ("component q of /other", "the file starts no node of this name")
    ]


def test_sections_that_no_node_gets_are_noted():
    """The nodes that a component makes get the parameters of the container alone, as in launch."""
    sections = ["/controller", "/planner", "/costmap/costmap"]
    part = Component(package="p", plugin="q", name="controller", sections=sections)
    other = Component(package="p", plugin="q", name="planner")
    (note,) = made(node(0, "box", kind="container", components=[part, other])).notes
    assert "component controller have sections for /costmap/costmap." in note
    whole = [Parameters(nodes="/costmap/costmap", values={"width": 3})]
    box = node(0, "box", kind="container", components=[part, other], parameters=whole)
    assert made(box).notes == []


def test_a_path_outside_of_packages_is_noted():
    """Such a path must exist on each host, which the user may not know."""
    (note,) = translation_of("tools.launch.yaml").notes
    assert "pause names /tmp, which must exist on each host" in note


def test_unnamed_nodes_keep_their_names_and_all_their_parameters():
    """Which sections apply is known to ROS only; names of processes are unique."""
    sections = [Parameters(nodes="/a", values={"x": 1}), Parameters(values={"y": 2})]
    work = made(node(0, parameters=sections), node(1)).work
    first, second = work["processes"]
    assert (first["name"], second["name"]) == ("e", "e-2")
    assert first["node_name"] == "keep"
    assert first["parameters"] == [
        {"/**": {"ros__parameters": {"y": 2}}}, {"/a": {"ros__parameters": {"x": 1}}},
    ]  # fmt: skip


def test_paths_inside_longer_texts_name_their_packages():
    """Only whole directories of known packages; a similar name stays as it is."""
    texts = ["--a=/i/share/demo/x:/i/lib/demo/y", "/i/share/demo_more/z", "/i/share/demo"]
    (entry,) = made(node(0, arguments=texts), packages={"demo": "/i"}).work["processes"]
    assert entry["arguments"] == [
        "--a=$(find-pkg-share demo)/x:$(find-pkg-prefix demo)/lib/demo/y", "/i/share/demo_more/z",
        "$(find-pkg-share demo)",
    ]  # fmt: skip


def test_a_start_at_each_end_of_a_respawning_process_is_left_out():
    """The same holds for all that would start after it."""
    after = [Wait(process=0, event="exited")]
    last = [Wait(process=1, event="exited")]
    translation = made(
        node(0, "a", respawn=True), node(1, "b", waits=after), node(2, "c", waits=last)
    )
    assert [one["name"] for one in translation.work["processes"]] == ["a"]
    assert [one.action for one in translation.omissions] == ["/b", "/c"]


def test_two_containers_of_one_name_are_refused():
    """Components could go into either."""
    twins = (node(0, "c", kind="container"), node(1, "c", kind="container"))
    with pytest.raises(ConfigError, match="2 containers have the name /c; rename one"):
        made(*twins)


def test_a_file_without_processes_is_refused():
    with pytest.raises(ConfigError, match="the launch file starts no process"):
        made()


# --- the file beside --------------------------------------------------------------------------


@pytest.fixture
def beside(tmp_path):
    """Return the completed specs of a launch file with settings."""

    def read(text):
        path = tmp_path / "talkers.rosrm.yaml"
        path.write_text(text)
        file = Path("/robot/talkers.launch.py")
        work = completed(translation_of("talkers.launch.py"), file, path)
        return {spec.name: spec for spec in checked_work(work, file, None).specs}

    return read


def test_the_settings_of_the_documentation_are_valid(tmp_path):
    """Those of the page on launch files."""
    page = (ROOT / "docs/how-to/launch-files.md").read_text(encoding="utf-8")
    (tmp_path / "robot.rosrm.yaml").write_text(page.partition("```yaml\n")[2].partition("```")[0])
    nodes = [node(0, "camera", namespace="/front"), node(1, "planner"), node(2, "map_server")]
    translation = made(*nodes, node(3, "detector"))
    path = Path("/x/robot.launch.py")
    target = checked_work(completed(translation, path, tmp_path / "robot.rosrm.yaml"), path, None)
    specs = {spec.name: spec for spec in target.specs}
    assert target.rollout.healthy_for == 3.0
    assert specs["front.camera"].required_labels == {"camera": "front"}
    assert specs["planner"].neighbours[0].processes == ("map_server",)
    assert specs["detector"].devices[0].kind == "gpu"


def test_settings_apply_by_names_and_patterns_of_nodes(beside):
    """Later patterns are merged over earlier ones; the names are those of nodes or processes."""
    specs = beside(
        "nodes:\n"
        "  '*': {needs: {memory: 50MB}}\n"
        "  /left/*: {labels: {required: {side: left}}, migration: relaunch}\n"
        "  left.driver: {needs: {cpu: 1}, near: talker_0}\n"
    )
    left = specs["left.driver"]
    assert left.needs == {"memory": 50e6, "cpu": 1.0}
    assert left.required_labels == {"side": "left"}
    assert left.migration.strategy == "relaunch"
    assert left.neighbours[0].processes == ("talker_0",)
    assert specs["pause"].needs == {"memory": 50e6}
    assert not specs["right.driver"].required_labels


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("node: {}", "unknown key 'node'; did you mean 'nodes'?"),
        ("nodes: [a]", "nodes: a mapping is required"),
        ("nodes: {/left/drive: {priority: 1}}", "no process or node is '/left/drive'; did you"),
        ("nodes: {talker_0: 5}", "nodes: talker_0: a mapping is required"),
        ("nodes: {talker_0: {package: x}}", "nodes: talker_0: package is in the launch file"),
        ("nodes: {talker_0: {nice: 99}}", "talkers.rosrm.yaml:1:26: nice"),
    ],
)
def test_a_wrong_setting_is_refused_with_its_place(beside, text, said):
    with pytest.raises(ConfigError) as refusal:
        beside(text)
    assert said in str(refusal.value)
