"""Package pins: every installed package is pinned, and every pin is allowed."""

from __future__ import annotations

import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from packaging.version import Version

from scripts.pins import OWN, PROJECTS, ROOT, digest, pin_lines, read, recorded, requirements

PYTHONS = ("3.10", "3.11", "3.12", "3.13")


def applies(requirement: Requirement, python: str) -> bool:
    environment = {"python_version": python, "python_full_version": f"{python}.0"}
    return requirement.marker is None or requirement.marker.evaluate(environment)


def pins(python: str) -> dict[str, Version]:
    """Return the exact version of each constrained package on one Python."""
    found: dict[str, Version] = {}
    for line in pin_lines():
        requirement = Requirement(line)
        if not applies(requirement, python):
            continue
        (specifier,) = requirement.specifier
        assert specifier.operator == "==", line
        assert found.setdefault(canonicalize_name(requirement.name), Version(specifier.version))
    return found


def test_the_pins_were_resolved_on_every_python() -> None:
    """`make pins` has resolved exactly these pins and requirements, and recorded that."""
    assert recorded() == digest(), "constraints.txt or a requirement has changed: run `make pins`"


def test_every_distribution_is_looked_at() -> None:
    parts = (
        "checkpoint container criu examples lab launch migration msgs report resources scoring "
        "simulate web"
    )
    assert {"rosrm", *(f"rosrm-{part}" for part in parts.split())} <= OWN


@pytest.mark.parametrize("python", PYTHONS)
@pytest.mark.parametrize("project", PROJECTS, ids=str)
def test_every_requirement_has_an_exact_version_that_it_allows(project: Path, python: str) -> None:
    exact = pins(python)

    for requirement in requirements(project):
        name = canonicalize_name(requirement.name)
        if name not in OWN and applies(requirement, python):
            assert name in exact, f"{requirement} is not in constraints.txt"
            assert exact[name] in requirement.specifier, f"{requirement}: {exact[name]}"


@pytest.mark.parametrize("project", PROJECTS, ids=str)
def test_every_distribution_runs_on_the_same_pythons_under_the_same_licence(project: Path) -> None:
    settings = read(project)["project"]

    assert settings["requires-python"] == ">=3.10"
    assert settings["license"] == "Apache-2.0"


def test_the_readme_installs_all_that_runs() -> None:
    """Its one pip command names rosrm with ROS 2, the interfaces and each plugin, pinned.

    The tools below `tools/` are optional, as are the services of containers, which come with them.
    """
    (line,) = re.findall(r"^\$ pip install (.*)$", (ROOT / "README.md").read_text(), re.MULTILINE)
    tools = [project.parent for project in PROJECTS if project.parent.parent.name == "tools"]
    optional = (Path(), Path("examples"), Path("composition_interfaces"), *tools)
    needed = [f"./{p.parent}" for p in PROJECTS if p.parent not in optional]
    assert sorted(shlex.split(line)) == sorted(["-c", "constraints.txt", ".[ros]", *needed])


#: Shows the help as where none of these distributions is installed.
ALONE = """
import sys
sys.modules.update(dict.fromkeys({absent!r}))
from rosrm.cli.command_tree import app
app(["--help"])
"""


def test_rosrm_alone_shows_its_help() -> None:
    """Without any plugin, and without the libraries that only plugins need."""
    plugins = [project.parent.name for project in PROJECTS if project.parent.parent.name]
    absent = [f"rosrm_{name}" for name in plugins] + ["backports.zstd", "cryptography"]
    assert "rosrm_criu" in absent
    words = [sys.executable, "-c", ALONE.format(absent=absent)]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    assert "submit" in done.stdout
