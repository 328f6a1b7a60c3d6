"""`colcon build` of all ROS packages but the interfaces, and what is installed."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from rosrm.runtime.ros_wheels import without_bootstrapper
from rosrm.version import __version__
from tests.unit.test_ros_packages import DISTRIBUTIONS, ROOT, tomllib

#: Prints the entry points of the distributions below a folder, by name and group.
SHOW = """
import json, sys
from importlib.metadata import distributions
print(json.dumps({
    one.metadata["Name"]: {
        group: {p.name: p.value for p in one.entry_points if p.group == group}
        for group in {p.group for p in one.entry_points}
    }
    for one in distributions(path=[p for p in sys.path if p.startswith(sys.argv[1])])
}))
"""


def output(words, folder, environment):
    done = subprocess.run(
        words, cwd=folder, env=environment, capture_output=True, text=True, timeout=500, check=False
    )
    assert done.returncode == 0, (done.stdout + done.stderr)[-3000:]
    return done.stdout


def files(folder: Path, but: str = "") -> set[str]:
    """Return the files of a Python package, but those in directories of one name."""
    found = (one.relative_to(folder) for one in folder.rglob("*") if one.is_file())
    return {str(one) for one in found if but not in one.parts}


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_a_workspace_builds_every_package(tmp_path):
    """Files and entry points are those of the wheels, and both forms of the command run."""
    # The build compiles nothing: compiled files in its result would come from the source folders.
    clean = without_bootstrapper(os.environ) | {"PYTHONDONTWRITEBYTECODE": "1"}
    clean["PATH"] = f"{Path(sys.prefix) / 'bin'}:{clean['PATH']}"
    output(["colcon", "build", "--base-paths", ROOT / "ros"], tmp_path, clean)
    sourced = output(["sh", "-c", ". install/setup.sh && env -0"], tmp_path, clean)
    overlay = dict(line.split("=", 1) for line in sourced.split("\0") if line)
    install = tmp_path / "install"
    shown = json.loads(output([sys.executable, "-c", SHOW, install], tmp_path, overlay))
    for name, file in DISTRIBUTIONS.items():
        project = tomllib.loads(file.read_text())["project"]
        points = {"console_scripts": project.get("scripts", {}), **project.get("entry-points", {})}
        assert shown[project["name"]] == {group: one for group, one in points.items() if one}
        (installed,) = install.glob(f"{name}/lib/python*/site-packages/{name}")
        assert files(installed) == files(file.parent / name, "__pycache__")
        assert (install / name / "share/ament_index/resource_index/packages" / name).is_file()
    # The second is what `ros2 run rosrm rosrm` finds.
    for command in ("rosrm", install / "rosrm/lib/rosrm/rosrm"):
        assert output([command, "--version"], tmp_path, overlay).startswith(f"rosrm {__version__} ")
