"""Launch orders from assignments, and environments of processes."""

from __future__ import annotations

import math
import stat
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import hypothesis.strategies as st
import pytest
import yaml
from hypothesis import given

from rosrm.errors import LaunchError
from rosrm.extensions.made import MadeLauncher
from rosrm.model.arrays import ArrayMembership
from rosrm.model.values import (
    Assignment,
    Container,
    InstanceId,
    Kind,
    ParameterSource,
    ProcessSpec,
    RestartPolicy,
    StopPolicy,
)
from rosrm.node.identity import identity_from
from rosrm.slave.launch.ament_index import find_executable
from rosrm.slave.launch.command import command_in_image, order_of, plain_launch, write_files
from rosrm.slave.launch.environment import (
    ProcessLocation,
    process_environment,
    without_bootstrapper,
)
from rosrm.slave.launch.launchers import Launchers
from rosrm.slave.launch.ros_arguments import join_arguments, parameters_text
from rosrm.supervisor.json_lines import LONGEST_LINE

HERE = ProcessLocation("robot1", "fleet", "/rosrm/state_config")
VENV = "/home/robot/venv"
SITE = f"{VENV}/lib/python3.12/site-packages"


def assignment(**fields) -> Assignment:
    spec = ProcessSpec(**{"name": "talker", **fields})
    return Assignment(InstanceId("talker", 7), spec, 1, "talker")


def shadow() -> Assignment:
    """Return a handoff's destination, whose alias differs from its node's own name."""
    spec = ProcessSpec(
        name="talker", namespace="robot", command=("node",), ros=True, parameters={"rate": 10},
        restart=RestartPolicy("always"),
    )  # fmt: skip
    return Assignment(InstanceId("talker", 8), spec, 3, "talker_1700000000", shadow=True)


def launched(tmp_path, given: Assignment, environment=None, python=sys.executable, where=HERE):
    """Return the launch order for an assignment."""
    launchers = Launchers({"podman": MadeLauncher(InImage(), ())})
    plain = plain_launch(
        given, environment or {}, python, where=where, state_directory=tmp_path,
        launchers=launchers,
    )  # fmt: skip
    return order_of(plain, launchers, where.host)


def order(tmp_path, environment=None, **fields):
    environment = {"PATH": "/usr/bin", **(environment or {})}
    return launched(tmp_path, assignment(**fields), environment)


def parameters(made):
    """Return the content of the parameters file of an order."""
    return yaml.safe_load(made.contents[made.argv[made.argv.index("--params-file") + 1]])


class InImage:
    """A launcher that changes nothing."""

    def prepare(self, launch):
        return launch


def test_programs_of_a_container_are_found_in_its_image(tmp_path):
    """The host may have neither the package nor the interpreter."""
    launchers = Launchers({"podman": MadeLauncher(InImage(), ())})
    expected = {
        ("module", "demo.node"): ("python3", "-m", "demo.node", "x"),
        ("command", ("run", "-v")): ("run", "-v", "x"),
    }
    for (key, value), argv in expected.items():
        given = assignment(
            **{key: value}, arguments=("x",), container=Container("ros:jazzy", "podman")
        )
        plain = plain_launch(
            given, {}, sys.executable, where=HERE, state_directory=tmp_path, launchers=launchers
        )
        made = order_of(plain, launchers, HERE.host)
        assert made.argv == argv


def test_an_executable_in_an_image_becomes_the_process_itself(tmp_path, monkeypatch):
    """A script asks `ros2` of the image for the prefix of the package."""
    ros2, program = tmp_path / "ros2", tmp_path / "lib" / "demo" / "talk"
    program.parent.mkdir(parents=True)
    ros2.write_text(f"#!/bin/sh\n[ $3 = demo ] && echo {tmp_path}\n")
    program.write_text("#!/bin/sh\necho $$ $*\n")
    ros2.chmod(0o755)
    program.chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:/usr/bin:/bin")
    command = command_in_image(ProcessSpec("p", package="demo", executable="talk"))
    with subprocess.Popen([*command, "a b"], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout.read() == f"{process.pid} a b\n"


@pytest.fixture
def prefix(tmp_path):
    """Create an ament prefix with a package that has two executables and another file."""
    prefix = tmp_path / "install"
    index = prefix / "share" / "ament_index" / "resource_index" / "packages"
    index.mkdir(parents=True)
    (index / "demo_nodes").write_text("")
    folder = prefix / "lib" / "demo_nodes"
    folder.mkdir(parents=True)
    for name, mode in (("talker", 0o755), ("listener", 0o755), ("notes", 0o644)):
        (folder / name).write_text("#!/bin/sh\n")
        (folder / name).chmod(mode)
    return prefix


# --- command lines ----------------------------------------------------------------------------


def test_a_plain_command_gets_nothing_added(tmp_path):
    """A command that is not a ROS node runs as written."""
    assert order(tmp_path, command=("sleep", "3"), arguments=("x",)).argv == ("sleep", "3", "x")


def test_the_home_of_a_program_and_directory_is_that_of_the_slaves_user(tmp_path, monkeypatch):
    """Arguments are passed as they are."""
    monkeypatch.setenv("HOME", "/home/robot")
    made = order(tmp_path, command=("~/run.sh", "~/x"), working_directory="~/maps")
    assert made.argv == ("/home/robot/run.sh", "~/x")
    assert made.working_directory == "/home/robot/maps"


def test_a_module_is_run_by_the_given_python(tmp_path):
    """`module` is `python -m`."""
    assert order(tmp_path, module="a.b", arguments=("x",)).argv == (
        sys.executable,
        "-m",
        "a.b",
        "x",
    )


def test_a_ros_node_gets_its_name_namespace_and_remappings(tmp_path):
    """The user's arguments come first, then the ROS arguments."""
    argv = order(
        tmp_path,
        command=("node",),
        ros=True,
        arguments=("--fast",),
        namespace="/ns",
        remappings={"chatter": "/other/chatter"},
    ).argv
    assert argv == (
        *("node", "--fast", "--ros-args", "-r", "__node:=talker", "-r", "__ns:=/ns"),
        *("-r", "chatter:=/other/chatter"),
    )


def test_an_alias_names_the_node(tmp_path):
    """In a handoff the assignment has the node's name, not the spec."""
    made = launched(tmp_path, shadow())
    assert "__node:=talker_1700000000" in made.argv
    assert parameters(made) == {"/**": {"ros__parameters": {"rate": 10}}}


def test_a_shadow_is_not_restarted(tmp_path):
    """A shadow's end is final, whatever its spec says; other instances follow their specs."""
    made = launched(tmp_path, shadow())
    assert made.restart == RestartPolicy("never")
    made = launched(tmp_path, replace(shadow(), shadow=False))
    assert made.restart == RestartPolicy("always")


@pytest.mark.parametrize(
    ("arguments", "joined"),
    [
        ((), ["--ros-args", "x"]),
        (("--ros-args", "-p", "a:=1"), ["--ros-args", "-p", "a:=1", "--", "--ros-args", "x"]),
        (("--ros-args", "--", "y"), ["--ros-args", "--", "y", "--ros-args", "x"]),
        (("--", "y"), ["--", "y", "--ros-args", "x"]),
    ],
)
def test_ros_arguments_of_the_user_are_closed_first(arguments, joined):
    """Unclosed ROS arguments of the user do not swallow those of rosrm."""
    assert join_arguments(arguments, ["--ros-args", "x"]) == joined


def test_the_order_has_the_policies_and_directory_of_the_spec(tmp_path):
    """The order has the spec's restart and stop policies and its directory."""
    made = order(
        tmp_path,
        command=("x",),
        working_directory="/tmp",
        restart=RestartPolicy(when="always"),
        stop=StopPolicy(1.0, 2.0),
    )
    assert made.restart.when == "always"
    assert made.stop == StopPolicy(1.0, 2.0)
    assert made.working_directory == "/tmp"


# --- packages ---------------------------------------------------------------------------------


def test_an_executable_is_found_through_the_ament_index(tmp_path, prefix):
    """The result is PREFIX/lib/PACKAGE/EXECUTABLE with its ROS arguments."""
    environment = {"AMENT_PREFIX_PATH": f"/opt/none:{prefix}"}
    made = order(tmp_path, environment, package="demo_nodes", executable="talker")
    assert made.argv[:2] == (str(prefix / "lib" / "demo_nodes" / "talker"), "--ros-args")


def test_a_program_of_a_package_that_is_no_node_gets_no_ros_arguments(tmp_path, prefix):
    environment = {"AMENT_PREFIX_PATH": str(prefix)}
    plain = {"package": "demo_nodes", "executable": "talker", "ros": False}
    made = order(tmp_path, environment, **plain)
    assert made.argv == (str(prefix / "lib" / "demo_nodes" / "talker"),)
    assert "ROSRM_NODE" not in process_environment(assignment(**plain), {}, HERE)


def test_packages_lie_in_the_prefix_of_python_too(tmp_path, prefix):
    """The ROS wheels set no AMENT_PREFIX_PATH: their packages are in the virtual environment."""
    given = assignment(package="demo_nodes", executable="talker")
    made = launched(tmp_path, given, python=str(prefix / "bin" / "python3"))
    assert made.argv[0] == str(prefix / "lib" / "demo_nodes" / "talker")


@pytest.mark.parametrize(
    ("package", "executable", "said"),
    [
        ("demo_node", "talker", ["'demo_node' was not found; did", "did you mean demo_nodes?"]),
        ("nothing", "talker", ["'nothing' was not found; "]),
        ("demo", "talker", ["did you mean demo_nodes?"]),
        ("demo_nodes", "talk", ["has no executable 'talk'", "did you mean talker"]),
        ("demo_nodes", "notes", ["notes", "is not executable"]),
    ],
)
def test_what_is_missing_is_named(tmp_path, prefix, package, executable, said):
    """The error has the missing name, the places searched, and similar names found there."""
    environment = {"AMENT_PREFIX_PATH": str(prefix)}
    with pytest.raises(LaunchError) as caught:
        order(tmp_path, environment, package=package, executable=executable)
    for part in [*said, str(prefix)]:
        assert part in str(caught.value)


@pytest.mark.parametrize(
    "fields",
    [
        {"package": "x" * 300, "executable": "talker"},
        {"package": "demo_nodes", "executable": "x" * 300},
        {"command": ("node",), "ros": True, "parameters": {"half": "\ud800"}},
    ],
    ids=["package", "executable", "parameter"],
)
def test_a_launch_that_the_system_refuses_ends_no_slave(tmp_path, prefix, fields):
    """A name is too long, or a text has no encoding: the instance is refused with the reason."""
    with pytest.raises(LaunchError, match=r"talker#7: .*(too long|encode)"):
        order(tmp_path, {"AMENT_PREFIX_PATH": str(prefix)}, **fields)


@pytest.mark.parametrize(
    "fields",
    [
        {"arguments": ("x" * LONGEST_LINE,)},
        {"environment": {"BIG": "\0" * (2 << 20)}},
        {"ros": True, "parameters": {"big": "x" * LONGEST_LINE}},
    ],
)
def test_a_launch_that_is_too_long_for_the_supervisor_is_refused(tmp_path, fields):
    """The supervisor would refuse the connection, and the slave would end."""
    with pytest.raises(LaunchError, match=r"talker#7: command line, .* have \d+ bytes"):
        order(tmp_path, command=("node",), **fields)


def test_a_package_with_an_unlike_name_is_no_suggestion(prefix):
    """Two words of one suffix are not misspelt forms of each other."""
    index = prefix / "share" / "ament_index" / "resource_index" / "packages"
    (index / "tracetools").touch()
    with pytest.raises(LaunchError) as caught:
        find_executable("image_tols", "x", [prefix])
    assert "did you mean" not in str(caught.value)


def test_a_few_packages_are_listed_and_many_counted(prefix):
    """The first names of many would not help; their number shows that the path is not empty."""
    with pytest.raises(LaunchError, match="'quux' was not found; there: demo_nodes"):
        find_executable("quux", "x", [prefix])
    index = prefix / "share" / "ament_index" / "resource_index" / "packages"
    for number in range(9):
        (index / f"a{number}_msgs").write_text("")
    with pytest.raises(LaunchError, match="none of the 10 that are there has a similar name"):
        find_executable("quux", "x", [prefix])


@pytest.mark.parametrize(
    ("text", "known", "expected"),
    [
        ("/x:{env.OF_HOST}", "/a:/b", "/x:/a:/b"),
        ("{env.OF_HOST}:/x", "/a", "/a:/x"),
        ("/x:{env.OF_HOST}", "", "/x"),
        ("{env.OF_HOST}:/x", None, "/x"),
        ("/x:{env.OF_HOST}:/y", None, "/x:/y"),
    ],
)
def test_a_variable_can_extend_that_of_the_host(tmp_path, text, known, expected):
    """One that is not set leaves no `:`, which would mean the current directory."""
    host = {} if known is None else {"OF_HOST": known}
    given = assignment(command=("/bin/sh",), environment={"OF_HOST": text})
    made = launched(tmp_path, given, host)
    assert made.environment["OF_HOST"] == expected


# --- parameters -------------------------------------------------------------------------------


def test_parameters_go_to_a_file_beside_the_log(tmp_path):
    """The file applies to any node name."""
    made = order(tmp_path, command=("node",), ros=True, parameters={"rate": 10})
    path = tmp_path / "logs" / "talker.7.parameters.yaml"
    assert made.argv[-2:] == ("--params-file", str(path))
    assert parameters(made) == {"/**": {"ros__parameters": {"rate": 10}}}


def test_sources_of_parameters_are_merged_in_their_order(tmp_path):
    """Files are read on the host; other nodes keep their sections, and an alias has its own."""
    file = tmp_path / "params.yaml"
    file.write_text(
        "/**: {ros__parameters: {rate: 2, tolerance: 1e-3, on: true}}\n"
        "/robot/talker: {ros__parameters: {rate: 3}}\n"
        "/robot/other: {ros__parameters: {rate: 4}}\n"
    )
    sources = (
        ParameterSource(parameters={"rate": 1, "first": "a"}), ParameterSource(str(file)),
        ParameterSource(nodes="/robot/*", parameters={"on": False}),
    )  # fmt: skip
    given = shadow()
    spec = replace(given.spec, parameter_sources=sources)
    sections = parameters(launched(tmp_path, replace(given, spec=spec)))
    assert list(sections) == ["/**", "/robot/other", "/robot/*", "/robot/talker_1700000000"]
    found = {nodes: section["ros__parameters"] for nodes, section in sections.items()}
    assert found["/**"] == {"rate": 2, "first": "a", "tolerance": 0.001, "on": True}
    assert found["/robot/other"] == {"rate": 4}
    assert found["/robot/talker_1700000000"] == {**found["/**"], "rate": 3, "on": False}


def test_nodes_that_keep_their_names_get_no_name(tmp_path):
    """Each section remains for the nodes of the program, and ROS applies it."""
    made = launched(
        tmp_path,
        Assignment(
            InstanceId("talker", 7),
            ProcessSpec(
                "talker", node_name="keep", command=("node",), ros=True,
                parameter_sources=(ParameterSource(nodes="/a", parameters={"x": 1}),),
            ),
            1, "",
        ),
    )  # fmt: skip
    assert made.argv[:3] == ("node", "--ros-args", "--params-file")
    assert parameters(made) == {"/a": {"ros__parameters": {"x": 1}}}
    assert "ROSRM_NODE" not in made.environment


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (None, "No such file or directory"),
        ("rate: 1\n", "`ros__parameters` is required below the name of a node"),
        ("a: [\n", "expected the node content"),
    ],
)
def test_a_wrong_file_of_parameters_is_refused(tmp_path, content, said):
    """The refusal names the file and the fault; the next host is tried."""
    path = tmp_path / "p.yaml"
    if content is not None:
        path.write_text(content)
    with pytest.raises(LaunchError, match=said):
        order(
            tmp_path, command=("node",), ros=True, parameter_sources=(ParameterSource(str(path)),)
        )


def test_a_prefix_comes_before_the_program(tmp_path):
    """A debugger or profiler gets the program as its arguments."""
    made = order(tmp_path, command=("prog", "-v"), prefix=("nice", "-n", "5"), arguments=("x",))
    assert made.argv == ("nice", "-n", "5", "prog", "-v", "x")


def test_directories_of_packages_are_those_of_the_host(tmp_path, prefix):
    """`$(find-pkg-share X)` may be in each text of a spec, and inside a longer one."""
    (prefix / "share/demo_nodes").mkdir()
    (prefix / "share/demo_nodes/p.yaml").write_text("/**: {ros__parameters: {a: 1}}")
    share, whole = "$(find-pkg-share demo_nodes)", "$(find-pkg-prefix demo_nodes)"
    made = order(
        tmp_path, {"AMENT_PREFIX_PATH": str(prefix)}, command=(f"{whole}/lib/demo_nodes/talker",),
        ros=True, arguments=(f"--a={share}/a:{share}/b",), working_directory=share,
        parameters={"maps": [f"{share}/m"]},
        parameter_sources=(ParameterSource(f"{share}/p.yaml"),),
    )  # fmt: skip
    there = f"{prefix}/share/demo_nodes"
    assert made.argv[:2] == (f"{prefix}/lib/demo_nodes/talker", f"--a={there}/a:{there}/b")
    assert made.working_directory == there
    assert parameters(made) == {"/**": {"ros__parameters": {"maps": [f"{there}/m"], "a": 1}}}


@pytest.mark.parametrize(
    ("container", "said"),
    [
        (Container(), "the ROS package 'nowhere' was not found"),
        (Container("i", "e"), "in the image"),
    ],
)
def test_an_unknown_package_in_a_text_is_refused(tmp_path, container, said):
    """In an image the packages are not known, so the path has to be written."""
    with pytest.raises(LaunchError, match=said):
        order(tmp_path, command=("x",), arguments=("$(find-pkg-share nowhere)/a",),
              container=container)  # fmt: skip


def test_no_parameters_no_file(tmp_path):
    """An empty file of parameters is an error to ROS 2."""
    made = order(tmp_path, command=("node",), ros=True, parameters={"nested": {}})
    assert "--params-file" not in made.argv


TEXTS = st.text(st.characters(exclude_categories=["Cs"]))
SCALARS = st.one_of(
    st.booleans(), st.integers(-(2**63), 2**63 - 1), st.floats(allow_nan=False), TEXTS
)
ARRAYS = st.one_of(
    *(st.lists(kind, min_size=1) for kind in (st.booleans(), st.integers(-9, 9), TEXTS))
)
PARAMETERS = st.recursive(
    st.dictionaries(TEXTS, st.one_of(SCALARS, ARRAYS), min_size=1),
    lambda inner: st.dictionaries(TEXTS, st.one_of(inner, SCALARS), min_size=1),
    max_leaves=5,
)


def typed(value):
    """Make types visible, because 1 == 1.0 == True."""
    if isinstance(value, dict):
        return {key: typed(inner) for key, inner in value.items()}
    if isinstance(value, list):
        return [typed(inner) for inner in value]
    return type(value).__name__, value


@given(PARAMETERS)
def test_parameters_survive_with_their_types(parameters):
    """Any JSON value reads back as what it was: text stays text, 1.0 stays a fraction."""
    read = yaml.load(parameters_text({"/**": parameters}), Loader=_Loader)
    assert typed(read["/**"]["ros__parameters"]) == typed(parameters)


class _Loader(yaml.SafeLoader):
    """Loader with YAML 1.2's numbers, as ROS 2 reads them: 1e-05 and 1e+22 are fractions."""


_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float",
    __import__("re").compile(r"^-?\d+(\.\d+)?(e[-+]?\d+)?$"),
    list("-0123456789"),
)
_Loader.yaml_implicit_resolvers = {
    first: sorted(rows, key=lambda row: "float" in row[0])
    for first, rows in _Loader.yaml_implicit_resolvers.items()
}


def test_whole_numbers_among_fractions_become_fractions():
    """A ROS array has one type."""
    assert "[1.0, 2.5]" in parameters_text({"/**": {"gains": [1, 2.5]}})


def test_what_is_no_number_is_written_as_yaml_does():
    """NaN and the infinities are written so."""
    text = parameters_text({"/**": {"a": math.nan, "b": -math.inf}})
    assert ".nan" in text
    assert "-.inf" in text


@pytest.mark.parametrize("value", [None, [], [1, "a"], [[1]], 2**63, [True, 1]])
def test_what_no_parameter_can_hold_is_refused(value):
    """The refusal names the parameter, nested ones too."""
    with pytest.raises(LaunchError, match=r"'outer\.inner'"):
        parameters_text({"/**": {"outer": {"inner": value}}})


# --- environment ------------------------------------------------------------------------------


BOOTSTRAPPED = {"_ROS_WHEELS_BOOTSTRAP_COMPLETE": "1"}


@pytest.mark.parametrize(
    ("library_path", "bootstrapped", "left"),
    [
        (f"{SITE}/ros_rcl.libs:/opt/mine:{VENV}/lib:{SITE}/ros_rclpy.libs", True, "/opt/mine"),
        (f"{sys.prefix}/lib:{SITE}/ros_rcl.libs", True, None),
        ("/opt/ros/jazzy/lib", False, "/opt/ros/jazzy/lib"),
    ],
    ids=["wheels", "wheels alone", "apt"],
)
def test_the_bootstrappers_variables_are_removed(library_path, bootstrapped, left):
    """Other entries of LD_LIBRARY_PATH stay, such as those that apt's ROS 2 needs."""
    before = {"LD_LIBRARY_PATH": library_path, "HOME": "/root"}
    made = without_bootstrapper({**before, **(BOOTSTRAPPED if bootstrapped else {})})
    assert made == {"HOME": "/root", **({"LD_LIBRARY_PATH": left} if left else {})}


def test_the_variables_of_the_spec_take_precedence():
    """A process has variables with its identity, and the spec's own variables take precedence."""
    made = process_environment(
        assignment(command=("x",), environment={"ROS_DOMAIN_ID": "9", "PYTHONUNBUFFERED": ""}),
        {"ROS_DOMAIN_ID": "5", "RMW_IMPLEMENTATION": "rmw_fastrtps_cpp"},
        HERE,
    )
    assert made == {
        "ROS_DOMAIN_ID": "9",
        "RMW_IMPLEMENTATION": "rmw_fastrtps_cpp",
        "ROSRM_PROCESS": "talker",
        "ROSRM_INSTANCE": "talker#7",
        "ROSRM_HOST": "robot1",
        "ROSRM_STATE_CONFIG": "/rosrm/state_config",
        "ROSRM_MASTER": "fleet",
        "ROSRM_EPOCH": "1",
        "PYTHONUNBUFFERED": "",
    }


def test_a_node_gets_its_own_name_in_its_environment():
    """The variables have the node's own name instead of the alias, and mark a shadow."""
    made = process_environment(shadow(), {}, HERE)
    assert made["ROSRM_NODE"] == "/robot/talker"
    assert made["ROSRM_SHADOW"] == "1"
    assert made["ROSRM_EPOCH"] == "3"
    packaged = assignment(package="demo_nodes", executable="talker", namespace="/")
    assert process_environment(packaged, {}, HERE)["ROSRM_NODE"] == "/talker"


def test_a_job_of_an_array_knows_its_index():
    """A process without an array has no index, even if its slave was started by such a job."""
    job = assignment(command=("x",), kind=Kind.JOB, array=ArrayMembership("r", 0))
    made = process_environment(job, {}, HERE)
    assert made["ROSRM_ARRAY_INDEX"] == "0"
    assert "ROSRM_ARRAY_INDEX" not in process_environment(assignment(command=("x",)), made, HERE)


def test_a_process_knows_the_file_with_the_masters_epoch():
    here = replace(HERE, epoch_file=Path("/state/epoch"))
    made = process_environment(assignment(command=("x",)), {}, here)
    assert made["ROSRM_EPOCH_FILE"] == "/state/epoch"
    assert "ROSRM_EPOCH_FILE" not in process_environment(assignment(command=("x",)), made, HERE)


KEYED = replace(HERE, instance_key=lambda instance: str(instance).encode().ljust(32))


def test_each_process_gets_the_key_of_its_instance_in_a_file(tmp_path):
    """A migratable node without a key would accept each message about a handoff from any sender.

    Such a node may be in any process, also in one whose strategy moves no state of nodes. The
    environment, which programs print and children inherit, does not have the key; the launcher of a
    container mounts the file.
    """
    image = Container("image", "podman")
    in_container = assignment(command=("x",), container=image)
    stateful = replace(assignment(command=("x",)), snapshots_from=1)
    for one in (stateful, assignment(command=("sleep", "9")), shadow(), in_container):
        made = launched(tmp_path, one, where=KEYED)
        assert "dGFsa2VyIzcg" not in str(made)
        write_files(made.contents)
        path = Path(made.environment["ROSRM_INSTANCE_KEY_FILE"])
        assert stat.S_IMODE(path.stat().st_mode) == 0o600
        assert identity_from(made.environment).key == str(one.instance).encode().ljust(32)
        assert "ROSRM_INSTANCE_KEY" not in made.environment
    without = launched(tmp_path, stateful, made.environment)
    assert "ROSRM_INSTANCE_KEY_FILE" not in without.environment


def test_the_identity_of_the_slave_is_not_inherited():
    """A slave may itself run under rosrm, even as a shadow; its processes do not inherit that."""
    slave = process_environment(shadow(), {}, HERE)
    made = process_environment(assignment(command=("x",)), slave, HERE)
    assert "ROSRM_SHADOW" not in made
    assert "ROSRM_NODE" not in made
    assert made["ROSRM_INSTANCE"] == "talker#7"
