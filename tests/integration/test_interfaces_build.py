"""Builds of `rosrm_msgs` by pip and by colcon."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

ROOT = Path(__file__).resolve().parents[2]
PACKAGE = ROOT / "rosrm_msgs"
#: Interfaces of ROUND_TRIP, with the messages in them.
FEW = ("msg/Answer.msg", "msg/Envelope.msg", "msg/ResourceInfo.msg", "srv/Reload.srv")

#: Publishes a message to itself and prints the path of its interfaces.
ROUND_TRIP = """
import time
import rclpy
import rosrm_msgs
from rosrm_msgs.msg import ResourceInfo
from rosrm_msgs.srv import Reload

rclpy.init()
node = rclpy.create_node("round_trip")
received = []
node.create_subscription(ResourceInfo, "resource_info", received.append, 10)
publisher = node.create_publisher(ResourceInfo, "resource_info", 10)
node.create_client(Reload, "reload")
sent = ResourceInfo(host_id=3, usage=[0.0, 0.0, 0.5])
end = time.monotonic() + 20.0
while not received and time.monotonic() < end:
    publisher.publish(sent)
    rclpy.spin_once(node, timeout_sec=0.1)
assert received[0] == sent
print("from", rosrm_msgs.__file__)
node.destroy_node()
rclpy.shutdown()
"""


def test_every_interface_is_listed_for_cmake() -> None:
    on_disk = {
        f"{kind}/{path.name}" for kind in ("msg", "srv") for path in (PACKAGE / kind).iterdir()
    }

    listed = re.findall(r'"((?:msg|srv|action)/[^"]+)"', (PACKAGE / "CMakeLists.txt").read_text())

    assert sorted(listed) == sorted(on_disk)


def test_pip_and_colcon_build_with_the_same_requirements() -> None:
    settings = tomllib.loads((PACKAGE / "pyproject.toml").read_text())
    build = settings["build-system"]["requires"]

    colcon = settings["project"]["optional-dependencies"]["colcon"]

    assert [r for r in colcon if r in build] == build


def test_pip_build_works() -> None:
    """`make setup` built the package with pip."""
    printed = round_trip(clean_environment(), PACKAGE.parent)

    assert f"from {sys.prefix}" in printed


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_colcon_build_works(tmp_path: Path) -> None:
    """The package keeps few interfaces; `make setup` has compiled all, with the same CMake."""
    source = tmp_path / "src" / PACKAGE.name
    shutil.copytree(PACKAGE, source)
    keep_few(source / "CMakeLists.txt")
    environment = clean_environment()
    environment["PATH"] = f"{Path(sys.prefix) / 'bin'}:{environment['PATH']}"
    # As after sourcing an installed ROS 2.
    environment["AMENT_PREFIX_PATH"] = environment["CMAKE_PREFIX_PATH"] = sys.prefix
    # Otherwise make waits while the machine is busy, even if only by its own load.
    environment["MAKEFLAGS"] = f"-j{os.cpu_count()}"
    against_wheels = source / "cmake" / "ros_wheels.cmake"

    built = subprocess.run(
        [
            *("colcon", "build", "--event-handlers", "console_direct+", "--cmake-args"),
            f"-DCMAKE_PROJECT_INCLUDE={against_wheels}",
            f"-DPython3_EXECUTABLE={sys.executable}",
            "-DBUILD_TESTING=OFF",
        ],
        cwd=tmp_path,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert built.returncode == 0, (built.stdout + built.stderr)[-5000:]

    sourced = subprocess.run(
        ["sh", "-c", ". install/setup.sh && env -0"],
        cwd=tmp_path,
        env=environment,
        capture_output=True,
        text=True,
        check=True,
    )
    overlay = dict(line.split("=", 1) for line in sourced.stdout.split("\0") if line)

    assert f"from {tmp_path / 'install'}" in round_trip(overlay, tmp_path)


def keep_few(cmake: Path) -> None:
    """Remove the interfaces that are not in FEW from a copy of CMakeLists.txt."""
    lines = cmake.read_text().splitlines(keepends=True)
    listed = {line: line.strip(' "\n') for line in lines if line.startswith('  "')}
    assert set(FEW) < set(listed.values())
    cmake.write_text("".join(line for line in lines if listed.get(line, FEW[0]) in FEW))


def clean_environment() -> dict[str, str]:
    """Return this environment without the variables of the ROS wheels' bootstrapper."""
    environment = dict(os.environ)
    for name in ("LD_LIBRARY_PATH", "_ROS_WHEELS_BOOTSTRAP_COMPLETE", "PYTHONPATH"):
        environment.pop(name, None)
    return environment | {
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
        "ROS_DOMAIN_ID": str(100 + os.getpid() % 100),
    }


def round_trip(environment: dict[str, str], folder: Path) -> str:
    """Return the output of ROUND_TRIP in a separate process."""
    run = subprocess.run(
        [sys.executable, "-c", ROUND_TRIP],
        cwd=folder,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
        timeout=60,
    )
    assert run.returncode == 0, run.stderr
    return run.stdout
