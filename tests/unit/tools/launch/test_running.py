"""The resolver as a process: faulty launch files, and a machine without `launch`."""

from __future__ import annotations

import os
import re
import sys
import tempfile
from importlib.util import find_spec
from pathlib import Path

import pytest

from rosrm.errors import ConfigError
from rosrm_launch.running import launch_file, resolve
from tests.launch_files import CASES, make_package, resolved, stored

ABSENT = [
    name for name in ("launch", "launch_ros", "composition_interfaces") if not find_spec(name)
]
needs_launch = pytest.mark.skipif(
    bool(ABSENT), reason=f"{', '.join(ABSENT)} of a ROS installation cannot be imported"
)


@pytest.fixture
def file(tmp_path):
    """Return a function that writes a launch file with a body of Python."""

    def write(body, name="robot.launch.py"):
        path = tmp_path / name
        imports = "import os, sys, time\nfrom launch import LaunchDescription as L\n"
        imports += "from launch.actions import *\nfrom launch_ros.actions import Node\n"
        lines = body.replace("\n", "\n    ")
        path.write_text(f"{imports}def generate_launch_description():\n    {lines}\n")
        return path

    return write


def refusal(file, *arguments, timeout=30.0):
    with pytest.raises(ConfigError) as refused:
        resolve(file, arguments, timeout=timeout)
    return str(refused.value)


# --- with a real launch -----------------------------------------------------------------------


@needs_launch
@pytest.mark.parametrize("name", CASES)
def test_the_stored_models_are_those_of_launch(tmp_path, name):
    """Arguments, conditions, scopes, files and events, as this version of launch sees them."""
    share = make_package(tmp_path / "install")
    assert resolved(share, name, *CASES[name]) == stored(name)


@needs_launch
def test_the_whole_of_a_parameters_file_is_in_the_model(file, tmp_path):
    """A process gets each section; of a component the names are kept, for a note."""
    parameters = tmp_path / "p.yaml"
    parameters.write_text(
        "/a: {ros__parameters: {x: 1}}\nb: {b: {ros__parameters: {y: 2}}}\n"
        "/**: {ros__parameters: {z: 3}}\n"
    )
    body = (
        "from launch_ros.actions import ComposableNodeContainer as C\n"
        "from launch_ros.descriptions import ComposableNode as D\n"
        f"files = [{str(parameters)!r}, {{'x': 4}}]\n"
        "part = D(package='p', plugin='q', name='a', parameters=files)\n"
        "return L([C(package='std_msgs', executable='e', name='box', namespace='/',\n"
        "    parameters=files, composable_node_descriptions=[part])])"
    )
    (box,) = resolve(file(body), [], timeout=30.0).processes
    given = [(one.nodes, one.values) for one in box.parameters]
    assert given == [("/a", {"x": 1}), ("/b/b", {"y": 2}), ("/**", {"z": 3}), ("/box", {"x": 4})]
    (part,) = box.components
    assert (part.parameters, part.sections) == ({"x": 4, "z": 3}, ["/a", "/b/b"])


@needs_launch
def test_nothing_is_started(file, tmp_path):
    """Commands are only recorded, also those that an event would start."""
    marker = tmp_path / "started"
    model = resolve(
        file(f"return L([ExecuteProcess(cmd=['touch', {str(marker)!r}])])"), [], timeout=30.0
    )
    assert model.processes[0].command == ["touch", str(marker)]
    assert not marker.exists()


@needs_launch
@pytest.mark.parametrize(
    ("body", "said"),
    [
        ("return 1 / 0", "robot.launch.py:6: ZeroDivisionError: division by zero"),
        ("sys.exit(3)", "robot.launch.py exits with 3 instead of describing a launch"),
        ("os._exit(4)", "the resolver ended without a result: exit code 4"),
        ("return 5", "robot.launch.py"),
        (
            "return L([DeclareLaunchArgument('map', description='Map')])",
            "required: map (Map); write map:=VALUE",
        ),
    ],
)
def test_a_faulty_launch_file_is_one_error(file, body, said):
    """The error names the file, its line where there is one, and the cause."""
    assert said in refusal(file(body))


@needs_launch
def test_an_unknown_argument_is_refused(file):
    """With the nearest one, and all others."""
    path = file("return L([DeclareLaunchArgument('speed', default_value='1')])")
    said = refusal(path, "sped:=2")
    assert "declares no argument sped; did you mean speed? Its arguments: speed" in said


@needs_launch
def test_a_file_that_never_ends_is_ended(file):
    """With all that it has started."""
    assert "not resolved within 3 s" in refusal(file("time.sleep(1000)"), timeout=3.0)


@needs_launch
def test_a_thread_of_the_file_does_not_keep_the_resolver(file):
    """Neither one of its own, nor that of a ROS node of launch."""
    body = "import threading\nthreading.Thread(target=time.sleep, args=(1000,)).start()\n"
    body += "from launch_ros.actions import SetUseSimTime\n"
    body += "return L([SetUseSimTime(True), Node(package='p', executable='e', name='n')])"
    (process,) = resolve(file(body), [], timeout=30.0).processes
    assert (process.name, process.parameters) == ("n", [])


@needs_launch
def test_arguments_that_only_substitutions_ask_for_are_known(file):
    """`ros2 launch` takes them, too; `sigterm_timeout` and `launch-prefix` are such arguments."""
    body = "from launch.substitutions import LaunchConfiguration as C\n"
    body += "return L([ExecuteProcess(cmd=['x', C('speed', default='1')])])"
    given = ["speed:=2", "sigterm_timeout:=9", "launch-prefix:=nice"]
    (process,) = resolve(file(body), given, timeout=30.0).processes
    assert process.command == ["x", "2"]
    assert (process.interrupt_grace, process.prefix) == (9.0, ["nice"])


@needs_launch
def test_a_temporary_file_of_the_launch_file_is_listed(file):
    """No host has such a file; a mere name is one that a process will make."""
    body = "import tempfile\nmade, name = tempfile.mkstemp('.sdf')[1], tempfile.mktemp('.txt')\n"
    body += "return L([ExecuteProcess(cmd=['x', f'--file={made}', name])])"
    model = resolve(file(body), [], timeout=30.0)
    (process,), (omission,) = model.processes, model.omissions
    assert omission.action == "temporary file of x"
    assert re.fullmatch(r"the launch file makes \S+\.sdf on this machine only", omission.reason)
    assert (Path(process.command[2]).parent, process.paths) == (Path(tempfile.gettempdir()), [])


@needs_launch
def test_a_process_of_two_events_starts_after_the_first(file):
    """An action that is executed twice is an error in launch."""
    body = "from launch.event_handlers import OnProcessExit as Exit\n"
    body += "a, b, c = [ExecuteProcess(cmd=[name]) for name in 'abc']\n"
    body += "return L([a, b, *(RegisterEventHandler(Exit(target_action=one, on_exit=c))\n"
    body += "  for one in (a, b))])"
    model = resolve(file(body), [], timeout=30.0)
    assert [one.command for one in model.processes] == [["a"], ["b"], ["c"]]
    assert [one.action for one in model.omissions] == ["second start of c"]


@needs_launch
def test_a_scope_ends_with_its_group(file, monkeypatch):
    """A variable that has the same value in the shell is set only where the file sets it."""
    monkeypatch.setenv("SIDE", "left")
    body = "return L([GroupAction([SetEnvironmentVariable('SIDE', 'left'),\n"
    body += "  ExecuteProcess(cmd=['x'])]), ExecuteProcess(cmd=['y'])])"
    inner, outer = resolve(file(body), [], timeout=30.0).processes
    assert (inner.environment, outer.environment) == ({"SIDE": "left"}, {})


@needs_launch
def test_output_of_the_file_is_not_the_result(file):
    """A launch file may print, also JSON."""
    path = file("print('{}')\nos.write(1, b'{}')\nreturn L([Node(package='p', executable='e')])")
    (process,) = resolve(path, [], timeout=30.0).processes
    assert process.executable == "e"


# --- without one ------------------------------------------------------------------------------


@pytest.mark.skipif(not ABSENT, reason="launch can be imported here")
def test_without_launch_the_error_says_where_it_comes_from(file):
    """The path of the interpreter shows which environment lacks it."""
    said = refusal(file("return L([])"))
    assert f"{sys.executable} cannot import `launch` and `launch_ros`" in said
    assert "/opt/ros/jazzy/setup.bash" in said


@pytest.mark.parametrize(
    ("code", "said"),
    [
        ("import time; time.sleep(1000)", "not resolved within 2 s, and was ended"),
        ("import os; os._exit(4)", "the resolver ended without a result: exit code 4"),
        ("import os; os.kill(os.getpid(), 11)", "without a result: killed by SIGSEGV"),
        ("raise RuntimeError('half installed')", "cannot import `launch` and `launch_ros`: half"),
        ("print('{}'); raise ImportError('too old')", "`launch_ros`: too old. They come with"),
    ],
)
def test_a_faulty_installation_of_launch_is_one_error(file, tmp_path, monkeypatch, code, said):
    """Whatever its import does, the command ends in time, and with the cause."""
    (tmp_path / "launch.py").write_text(code)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path), prepend=os.pathsep)
    assert said in refusal(file("return L([])"), timeout=2.0 if "sleep" in code else 30.0)


def test_a_launch_file_is_found_in_its_package(tmp_path, monkeypatch):
    """In any folder of its share directory, as `ros2 launch` does."""
    share = make_package(tmp_path)
    monkeypatch.setenv("AMENT_PREFIX_PATH", str(tmp_path))
    assert launch_file(["demo_robot", "events.launch.py"]) == share / "launch/events.launch.py"


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ([], "give a launch file, or a package"),
        (["a", "b", "c"], "give a launch file, or a package"),
        (["no.launch.py"], "no.launch.py: no such launch file; give PACKAGE FILE"),
        (["nowhere", "x"], "the ROS package 'nowhere' was not found"),
        (["demo_robot", "event.launch.py"], "did you mean 'events.launch.py'?"),
    ],
)
def test_a_launch_file_that_is_not_there(tmp_path, monkeypatch, words, said):
    make_package(tmp_path)
    monkeypatch.setenv("AMENT_PREFIX_PATH", str(tmp_path))
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ConfigError) as refused:
        launch_file(words)
    assert said in str(refused.value)
