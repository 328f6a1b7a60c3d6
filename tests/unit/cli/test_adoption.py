"""Entry of a work file from the command line and the environment of a process."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from rosrm.cli.adoption.entry import entry_of
from rosrm.cli.adoption.environment import variables_of
from rosrm.cli.adoption.facts import ProcessFacts, read_facts
from rosrm.cli.adoption.ros_words import RosWords
from rosrm.config.work import processes_of
from rosrm.errors import Refused
from rosrm.model.values import KEEP_NAME, ParameterSource
from rosrm.supervisor.adoption import is_own
from tests.waiting import command_of, wait_until

PACKAGES = "share/ament_index/resource_index/packages"


@pytest.fixture
def prefix(tmp_path: Path) -> Path:
    """Return a prefix with the executable `talker` of the package `demo`."""
    folder = tmp_path / "opt" / "lib" / "demo"
    folder.mkdir(parents=True)
    (folder / "talker").write_text("#!/bin/sh\n")
    (folder / "talker").chmod(0o755)
    (tmp_path / "opt" / PACKAGES).mkdir(parents=True)
    (tmp_path / "opt" / PACKAGES / "demo").touch()
    return tmp_path / "opt"


def facts(*words: str, directory: str = "/ws", has_ros: bool = False, **variables: str):
    """Return the facts about a process with a command line and an environment."""
    environment = {"PATH": "/usr/bin:/bin", **variables}
    return ProcessFacts(4711, 17, words, "/usr/bin/program", directory, environment, has_ros)


def keys_of(found: ProcessFacts, **host: str) -> dict:
    """Return the keys of the entry, which must be a valid work file."""
    keys = entry_of(found, "mine", host).keys
    assert processes_of(keys)[0].name == "mine"
    return keys


def test_an_executable_of_a_package_is_found_back(prefix) -> None:
    """Other hosts find it by its package, wherever it is there; so no directory is taken."""
    words = str(prefix / "lib/demo/talker"), "--loud", "--ros-args", "-r", "__node:=left"
    keys = keys_of(facts(*words, AMENT_PREFIX_PATH=str(prefix)), AMENT_PREFIX_PATH=str(prefix))
    assert keys == {
        "name": "mine", "package": "demo", "executable": "talker", "arguments": ["--loud"],
        "node_name": "left", "migration": "relaunch",
    }  # fmt: skip


def test_an_executable_in_python_is_found_back(prefix) -> None:
    """The interpreter is in the command line of the process, not in that of `ros2 run`."""
    words = "/usr/bin/python3", str(prefix / "lib/demo/talker")
    keys = keys_of(facts(*words, AMENT_PREFIX_PATH=str(prefix)))
    assert (keys["package"], keys["executable"]) == ("demo", "talker")
    assert keys["environment"] == {"AMENT_PREFIX_PATH": str(prefix)}


def test_ros2_run_is_a_package() -> None:
    """`ros2 run` needs no `ros2` for a restart."""
    words = "/usr/bin/python3", "/opt/ros/jazzy/bin/ros2", "run", "demo", "talker", "--loud"
    keys = keys_of(facts(*words))
    assert keys == {
        "name": "mine", "package": "demo", "executable": "talker", "arguments": ["--loud"],
        "node_name": "keep", "migration": "relaunch",
    }  # fmt: skip


def test_a_file_below_another_lib_is_a_command(prefix) -> None:
    """Only a package of the index is one."""
    (prefix / PACKAGES / "demo").unlink()
    program = str(prefix / "lib/demo/talker")
    keys = keys_of(facts(program, AMENT_PREFIX_PATH=str(prefix)))
    assert (keys["command"], keys["working_directory"]) == ([program], "/ws")
    assert "ros" not in keys


def test_a_script_has_an_absolute_path_and_its_interpreter(tmp_path) -> None:
    """A virtual environment is a link to the interpreter, which is not followed."""
    link = tmp_path / "python3"
    link.symlink_to(sys.executable)
    keys = keys_of(facts("python3", "talk.py", "x", directory=str(tmp_path), PATH=str(tmp_path)))
    assert keys["command"] == [str(link), str(tmp_path / "talk.py")]
    assert keys["arguments"] == ["x"]
    assert keys["working_directory"] == str(tmp_path)


def test_a_module_and_its_options_stay_a_command() -> None:
    """Another interpreter may not have the module."""
    keys = keys_of(facts("/bin/sh", "-c", "true"))
    assert (keys["command"], keys["arguments"]) == (["/bin/sh"], ["-c", "true"])
    keys = keys_of(facts(sys.executable, "-m", "demo", "--fast"))
    assert (keys["command"], keys["arguments"]) == ([sys.executable], ["-m", "demo", "--fast"])


def test_a_program_that_is_not_found_by_its_word_is_the_file_that_runs() -> None:
    """A program may set its own command line, or have none."""
    assert keys_of(facts("my robot: idle"))["command"] == ["/usr/bin/program"]
    assert keys_of(facts())["command"] == ["/usr/bin/program"]


def test_a_set_title_hides_the_arguments() -> None:
    """A set title leaves empty words; a program with an empty last argument keeps its words."""
    keys = keys_of(facts("my robot: idle", "", ""))
    assert (keys["command"], keys.get("arguments")) == (["/usr/bin/program"], None)
    assert keys_of(facts("/bin/echo", "x", ""))["arguments"] == ["x", ""]


def test_a_removed_executable_has_its_former_path(tmp_path) -> None:
    """The kernel marks such a path, which then names no file."""
    program = tmp_path / "sleep"
    shutil.copy("/bin/sleep", program)
    with subprocess.Popen([program, "1000"], cwd=tmp_path) as process:
        try:
            wait_until(lambda: command_of(process.pid).startswith(str(program)), "its exec")
            program.unlink()
            assert read_facts(process.pid).program == str(program)
        finally:
            process.kill()


def test_a_node_without_ros_arguments_keeps_its_names() -> None:
    """The process has loaded the client library, so its readiness is its presence in the graph."""
    (spec,) = processes_of(keys_of(facts("/bin/sh", has_ros=True)))
    assert (spec.ros, spec.node_name, spec.node) == (True, KEEP_NAME, "")


def test_ros_arguments_become_keys() -> None:
    """Names, rules and parameters in their order; the others stay ROS arguments."""
    names = "-x --ros-args -r __node:=left -r __ns:=/robot -r image:=front/image"
    others = "--log-level debug --params-file p.yaml"
    parameters = "-p rate:=10 -p frame:=base -p gains:=[1.0,2.0] -- -y"
    words = f"{names} {others} {parameters}".split()
    (spec,) = processes_of(keys_of(facts("/bin/sh", *words, directory="/ws")))
    assert spec.arguments == ("-x", "-y", "--ros-args", "--log-level", "debug")
    assert (spec.node_name, spec.namespace) == ("left", "/robot")
    assert spec.remappings == {"image": "front/image"}
    assert spec.parameter_sources == (
        ParameterSource(file="/ws/p.yaml"),
        ParameterSource(parameters={"rate": 10}),
        ParameterSource(parameters={"frame": "base"}),
        ParameterSource(parameters={"gains": [1.0, 2.0]}),
    )


@pytest.mark.parametrize(
    "words",
    [
        ["-p", "talker:rate:=10", "-p", "rate:=5"],
        ["-p", "rate:=null"],
        ["-p", "rate:=[1, 2"],
        ["-p", "rate"],
        ["-p"],
        ["-r", "talker:chatter:=x"],
        ["-r", "chatter"],
        ["--remap"],
    ],
)
def test_what_no_key_can_say_stays_a_ros_argument(words) -> None:
    """All parameters stay with it, because their order decides."""
    found = RosWords(["--ros-args", *words], "/ws")
    assert [word for word in found.arguments if word] == ["--ros-args", *words]
    assert found.keys == {}


def test_variables_of_ros_are_taken_and_no_secrets() -> None:
    """Values that the host has, too, are not repeated; of the others only the names are known."""
    process = {
        "ROS_DOMAIN_ID": "7", "RMW_IMPLEMENTATION": "rmw_x", "CYCLONEDDS_URI": "file:///c.xml",
        "ROS_API_TOKEN": "s3cret", "AWS_SECRET_ACCESS_KEY": "s3cret", "HOME": "/home/ada",
    }  # fmt: skip
    host = {"ROS_DOMAIN_ID": "7", "HOME": "/home/ada", "LANG": "C"}
    found = variables_of(process, host)
    assert found.taken == {"RMW_IMPLEMENTATION": "rmw_x", "CYCLONEDDS_URI": "file:///c.xml"}
    assert found.left == ["AWS_SECRET_ACCESS_KEY", "ROS_API_TOKEN"]


def test_a_node_of_another_domain_is_ready_as_soon_as_it_runs() -> None:
    """The host does not see its graph; a process without the variable is in domain 0."""
    keys = keys_of(facts("/bin/sh", has_ros=True), ROS_DOMAIN_ID="7")
    assert (keys["environment"], keys["readiness"]) == ({"ROS_DOMAIN_ID": "0"}, "running")


def test_a_cluster_without_relaunch_gets_no_strategy() -> None:
    """The master would refuse a strategy that it does not have."""
    assert "migration" not in entry_of(facts("/bin/sh"), "mine", {}, moves=False).keys


# --- the process ------------------------------------------------------------------------------


def test_facts_of_a_process(tmp_path) -> None:
    """Words, directory and environment of a real process, which loads no ROS."""
    words = ["sh", "-c", "read line", ""]
    process = subprocess.Popen(words, cwd=tmp_path, env={"A": "b=c\nd"}, stdin=subprocess.PIPE)
    try:
        found = read_facts(process.pid)
        assert (found.words, found.directory) == (tuple(words), str(tmp_path))
        assert (found.environment, found.has_ros) == ({"A": "b=c\nd"}, False)
    finally:
        process.communicate()


@pytest.mark.parametrize("pid", [-1, 0, 2**31, 2**70])
def test_a_pid_of_no_process_is_refused(pid) -> None:
    """Also one that no process can have."""
    with pytest.raises(Refused, match=f"no process {pid} runs on this machine"):
        read_facts(pid)


def test_the_first_process_is_refused() -> None:
    """Before the master is asked."""
    with pytest.raises(Refused, match="process 1 is not adopted: it is the first process"):
        read_facts(1)


def test_an_instance_is_refused() -> None:
    """The mark of its supervisor is in its environment."""
    marks = {"ROSRM_INSTANCE": "talker#3", "ROSRM_SUPERVISOR": "/state"}
    process = subprocess.Popen(["sleep", "1000"], env={**os.environ, **marks})
    try:
        with pytest.raises(Refused, match="it is the instance talker#3 of rosrm already"):
            read_facts(process.pid)
    finally:
        process.kill()
        process.wait()


@pytest.mark.parametrize(
    ("words", "own"),
    [
        ("/v/bin/python3 /v/bin/rosrm slave", True),
        ("rosrm master", True),
        ("/v/bin/python3 -m rosrm.slave 3", True),
        ("python3 /opt/ros/jazzy/bin/ros2 rosrm slave", True),
        ("/usr/bin/python3 -I -S /v/rosrm/supervisor/bare_interpreter.py /state", True),
        ("rosrm container --ros-args", False),
        ("/v/bin/python3 -m rosrm.node.container", False),
        ("vim rosrm", False),
        ("python3 -m", False),
        ("", False),
    ],
)
def test_processes_of_rosrm_are_known_by_their_words(words, own) -> None:
    """A component container belongs to the user."""
    assert is_own(words.split()) is own
