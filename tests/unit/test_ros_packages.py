"""ROS packages in `ros/`: each distribution has one, which says nothing that differs from it."""

from __future__ import annotations

import re
import sys
from pathlib import Path
from xml.etree import ElementTree as ET

import pytest

from rosrm.version import __version__

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

ROOT = Path(__file__).resolve().parents[2]
FILES = [
    file
    for folder in (".", "examples", "plugins/*", "tools/*")
    for file in ROOT.glob(f"{folder}/pyproject.toml")
]


def package_of(file: Path) -> str:
    """Return the name of the one Python package of a distribution."""
    build = tomllib.loads(file.read_text())["tool"]["hatch"]["build"]
    (name,) = build["targets"]["wheel"]["packages"]
    return name


#: Python package to the pyproject.toml of its distribution.
DISTRIBUTIONS = {package_of(file): file for file in FILES}


def test_every_distribution_has_a_ros_package():
    """A workspace with the repository builds all of them."""
    assert {one.parent.name for one in ROOT.glob("ros/*/package.xml")} == set(DISTRIBUTIONS)


@pytest.mark.parametrize("name", DISTRIBUTIONS)
def test_the_files_of_a_ros_package(name):
    """Version, name, marker and links are those that colcon and the ROS index need."""
    folder = ROOT / "ros" / name
    manifest = ET.parse(folder / "package.xml")
    project = tomllib.loads(DISTRIBUTIONS[name].read_text())["project"]
    assert manifest.findtext("name") == name == project["name"].replace("-", "_")
    assert manifest.findtext("version") == project.get("version", __version__)
    assert [one.name for one in (folder / "resource").iterdir()] == [name]
    assert (folder / "setup.py").resolve() == ROOT / "ros/ament_python_setup.py"
    assert (folder / name).resolve() == DISTRIBUTIONS[name].parent / name
    ours = {re.split("[>=; ]", one)[0].replace("-", "_") for one in project["dependencies"]}
    assert ours & set(DISTRIBUTIONS) <= {one.text for one in manifest.iter("exec_depend")}
