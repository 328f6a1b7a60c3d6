"""The ROS package `rosrm_node_cpp`: its files, and its compilation against stubs of rclcpp."""

from __future__ import annotations

import re
from xml.etree import ElementTree as ET

import pytest

from rosrm.version import __version__
from tests.cpp.core_library import PACKAGE, ROOT, run_compiler
from tests.programs import needs

CMAKE = (PACKAGE / "CMakeLists.txt").read_text()
MANIFEST = ET.parse(PACKAGE / "package.xml")


def test_every_source_is_built():
    """A file that CMakeLists.txt does not list would be missing in the library."""
    listed = set(re.findall(r"^  (src/\S+\.cpp)$", CMAKE, re.MULTILINE))
    assert listed == {str(one.relative_to(PACKAGE)) for one in PACKAGE.glob("src/**/*.cpp")}


def test_the_manifest_names_what_the_build_needs():
    """`rosdep install` and the order of colcon follow the manifest."""
    found = set(re.findall(r"^find_package\((\w+) REQUIRED\)", CMAKE, re.MULTILINE))
    named = {one.text for tag in ("buildtool_depend", "depend") for one in MANIFEST.iter(tag)}
    assert named - {"libsodium-dev"} == found - {"PkgConfig"}
    assert MANIFEST.findtext("name") == PACKAGE.name
    assert MANIFEST.findtext("version") == __version__


@needs("g++")
@pytest.mark.parametrize(
    "source",
    [
        PACKAGE / "src/node.cpp",
        PACKAGE / "examples/counter.cpp",
        ROOT / "tests/cpp/every_method.cpp",
    ],
    ids=lambda one: one.name,
)
def test_what_needs_rclcpp_compiles_against_its_declarations(source):
    """The stubs mirror rclcpp 28.1.6 (Jazzy), which can be neither installed here nor linked."""
    run_compiler("-fsyntax-only", str(source))


@needs("g++")
def test_the_core_needs_no_ros(tmp_path):
    """Only `node.hpp` and `node.cpp` include files of ROS."""
    headers = sorted(PACKAGE.glob("include/rosrm_node_cpp/core/*.hpp"))
    every = tmp_path / "every.cpp"
    every.write_text("".join(f'#include "{one}"\n' for one in headers))
    run_compiler("-fsyntax-only", str(every))
    sources = [*headers, *PACKAGE.glob("src/core/*.cpp")]
    assert not [
        one.name for one in sources if re.search(r'include "(rclcpp|\w+_msgs)/', one.read_text())
    ]


def test_the_page_shows_the_example():
    """The documentation contains the file that is compiled."""
    page = (ROOT / "docs/how-to/stateful-node.md").read_text()
    assert f"```cpp\n{(PACKAGE / 'examples/counter.cpp').read_text()}```" in page
