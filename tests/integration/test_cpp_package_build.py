"""CMake's build of `rosrm_node_cpp` by the real ament_cmake, with stubs in place of rclcpp."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from rosrm.runtime.ros_wheels import without_bootstrapper
from tests.cpp.core_library import PACKAGE, STUBS
from tests.programs import needs

#: Packages that only a ROS installation with rclcpp has.
ABSENT = ("rclcpp", "rcl_interfaces", "rosrm_msgs", "std_msgs")
SODIUM = f"""
Name: libsodium
Description: declarations of libsodium
Version: 1.0.18
Libs:
Cflags: -I{STUBS}
"""


def run(*words: str | Path, environment: dict[str, str]) -> None:
    done = subprocess.run(
        words, env=environment, capture_output=True, text=True, timeout=240, check=False
    )
    assert done.returncode == 0, (done.stdout + done.stderr)[-3000:]


@pytest.mark.slow
@pytest.mark.timeout(500)
@needs("cmake", "pkg-config", "make", "g++")
def test_ament_cmake_builds_the_library(tmp_path):
    """The library is compiled and linked; the example needs rclcpp itself."""
    for name in ABSENT:
        config = tmp_path / f"share/{name}/cmake/{name}Config.cmake"
        config.parent.mkdir(parents=True)
        config.write_text(f"set({name}_INCLUDE_DIRS {STUBS})\n")
    (tmp_path / "libsodium.pc").write_text(SODIUM)
    environment = without_bootstrapper(os.environ) | {"PKG_CONFIG_PATH": str(tmp_path)}
    environment["PATH"] = f"{Path(sys.prefix) / 'bin'}:{environment['PATH']}"
    build = tmp_path / "build"
    prefixes = f"-DCMAKE_PREFIX_PATH={tmp_path};{sys.prefix}"
    makefiles = "-GUnix Makefiles"
    run("cmake", "-S", PACKAGE, "-B", build, prefixes, makefiles, environment=environment)
    run("cmake", "--build", build, "--target", PACKAGE.name, environment=environment)
    assert (build / "librosrm_node_cpp.so").is_file()
