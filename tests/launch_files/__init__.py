"""Launch files of several styles, with the models that the resolver printed with a real `launch`.

The files are of a package `demo_robot` that tests make on the spot. `launch` is in no package
index, so most machines translate the stored models. `python -m tests.launch_files` prints them
again where `launch` can be imported.
"""

from __future__ import annotations

import json
import os
import shutil
import stat
import subprocess
import sys
from pathlib import Path
from typing import Any

FILES = Path(__file__).parent
MODELS = FILES / "models"
#: Each launch file with arguments.
CASES = {
    "talkers.launch.py": ("talkers:=1",),
    "sensors.launch.xml": ("rate:=8.0",),
    "tools.launch.yaml": (),
    "events.launch.py": (),
    "scopes.launch.py": (),
    "lifecycle.launch.py": (),
    "components.launch.py": (),
    "components.launch.xml": (),
}
#: Variables of the shell in which they were resolved.
VARIABLES = {"DEMO_MODE": "plain", "DEMO_GONE": "1", "DEMO_PATH": "/opt"}
#: Install prefix in the stored models.
STORED_PREFIX = "/robot/install"


def make_package(prefix: Path, program: str = "") -> Path:
    """Make the package in an install prefix, and return its share directory.

    `program`: Python code of its executable `talker`.
    """
    marker = prefix / "share/ament_index/resource_index/packages/demo_robot"
    marker.parent.mkdir(parents=True)
    marker.write_text("")
    share = prefix / "share/demo_robot"
    (share / "launch").mkdir(parents=True)
    (share / "maps").mkdir()
    (share / "maps/hall.yaml").write_text("image: hall.pgm\n")
    shutil.copytree(FILES / "config", share / "config")
    for name in CASES:
        shutil.copy(FILES / name, share / "launch")
    executable = prefix / "lib/demo_robot/talker"
    executable.parent.mkdir(parents=True)
    executable.write_text(f"#!{sys.executable}\n{program}")
    executable.chmod(executable.stat().st_mode | stat.S_IXUSR)
    return share


def stored(name: str) -> dict[str, Any]:
    """Return the stored model of a launch file."""
    return dict(json.loads((MODELS / f"{name}.json").read_text()))


def resolved(share: Path, name: str, *arguments: str) -> dict[str, Any]:
    """Return what the resolver prints for a launch file of the package, with the stored prefix."""
    prefix = share.parent.parent
    before = os.environ.get("AMENT_PREFIX_PATH", "")
    environment = {**os.environ, **VARIABLES, "AMENT_PREFIX_PATH": f"{prefix}:{before}"}
    done = subprocess.run(
        [sys.executable, "-m", "rosrm_launch.resolve", share / "launch" / name, *arguments],
        env=environment, stdout=subprocess.PIPE, check=True, timeout=60,
    )  # fmt: skip
    return dict(json.loads(done.stdout.replace(str(prefix).encode(), STORED_PREFIX.encode())))
