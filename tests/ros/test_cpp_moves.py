"""Moves of the examples as real processes: in Python, and in C++ where rclcpp is installed.

The tests of the protocol run the core of `rosrm_node_cpp` under an adapter in Python; in these
tests the core runs with rclcpp.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from contextlib import ExitStack
from itertools import cycle, islice
from pathlib import Path

import pytest
from std_msgs.msg import Int64

from rosrm.runtime.ros_wheels import without_bootstrapper
from rosrm_msgs.msg import StateConfig
from tests.cpp.core_library import PACKAGE, ROOT
from tests.programs import require
from tests.ros.handoff_kit import goes_on, is_gapless
from tests.ros.nodes import PATIENCE, Conductor

#: Folders of ROS installations, beside those in the environment.
INSTALLED = ("/opt/ros/jazzy",)


def rclcpp_prefix() -> Path | None:
    """Return the folder of a ROS installation with rclcpp; None: there is none."""
    folders = [*os.environ.get("AMENT_PREFIX_PATH", "").split(":"), *INSTALLED]
    found = (Path(one) for one in folders if one)
    return next((one for one in found if (one / "share/rclcpp/package.xml").is_file()), None)


@pytest.fixture(scope="module")
def cpp_counter(tmp_path_factory) -> list[str]:
    """Return the command of the counter in C++, built as its page says."""
    prefix = rclcpp_prefix()
    if prefix is None:
        pytest.skip("rclcpp is not installed (package ros-jazzy-rclcpp)")
    require("colcon")
    folder = tmp_path_factory.mktemp("cpp")
    build = ["colcon", "build", "--base-paths", ROOT / "rosrm_msgs", PACKAGE]
    environment = without_bootstrapper(os.environ)
    done = subprocess.run(
        ["bash", "-c", '. "$0/setup.bash" && exec "$@"', prefix, *build],
        cwd=folder, env=environment, capture_output=True, text=True, timeout=1200, check=False,
    )  # fmt: skip
    assert done.returncode == 0, (done.stdout + done.stderr)[-4000:]
    program = folder / f"install/{PACKAGE.name}/lib/{PACKAGE.name}/counter"
    return ["bash", "-c", '. "$0/install/setup.bash" && exec "$@"', str(folder), str(program)]


def command(language: str, request) -> list[str]:
    if language == "Python":
        return [sys.executable, "-m", "rosrm_examples.counter"]
    return request.getfixturevalue("cpp_counter")


def end(process: subprocess.Popen[bytes]) -> None:
    process.send_signal(signal.SIGINT)
    try:
        process.wait(PATIENCE)
    finally:
        process.kill()
        process.wait()


@pytest.mark.slow
@pytest.mark.timeout(2000)
@pytest.mark.parametrize(
    ("languages", "moves"),
    [(("Python",), 2), (("C++",), 20), (("Python", "C++"), 4)],
    ids=["Python", "C++", "in turn"],
)
def test_a_process_moves_without_a_loss(stage, request, languages, moves):
    """Each count is published once, in order, and each source exits with 0."""
    commands = islice(cycle([command(one, request) for one in languages]), moves + 1)
    counts = stage.listen(Int64, "count")
    with ExitStack() as ends:

        def started(number: int, words: list[str]) -> subprocess.Popen[bytes]:
            environment = without_bootstrapper(os.environ) | stage.environment(
                "counter", number, shadow=number > 1
            )
            alias = ["--ros-args", "-r", f"__node:=counter_{number}"] if number > 1 else []
            process = subprocess.Popen(
                [*words, *alias], env=environment | {"ROS_DOMAIN_ID": str(stage.domain)}
            )
            ends.callback(end, process)
            return process

        instances = enumerate(commands, start=1)
        source = started(*next(instances))
        goes_on(stage, counts)
        for number, words in instances:
            destination = started(number, words)
            conductor = Conductor(stage, source=number - 1, destination=number)
            conductor.hand_over()
            end(source)
            assert source.returncode == 0
            conductor.say(StateConfig.DONE)
            goes_on(stage, counts)
            source = destination
    assert is_gapless(counts)
