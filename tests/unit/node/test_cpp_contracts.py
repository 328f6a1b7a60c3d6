"""Arguments that `rosrm_node_cpp` passes to rclcpp, on a double that refuses the same ones.

tests/cpp/stubs/README.md lists the calls and the contract of each.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys

import pytest

from tests.cpp.core_library import PACKAGE, ROOT, STUBS, library_of, loaded
from tests.programs import require

SOURCE = ROOT / "tests/cpp/contracts.cpp"
CASES = re.findall(r'^  \{"(\w+)", ', SOURCE.read_text(), re.MULTILINE)
#: Names in the double that are not rclcpp's.
STANDARD = frozenset(
    {"Node", "c_str", "callback", "count", "empty", "end", "erase", "front", "lock", "move", "name",
     "node_", "now", "push_back", "rfind", "runtime_error", "size", "void"}
)  # fmt: skip
#: Runs a case in a process of its own, because an exception in a destructor ends the process.
RUN = """
import sys
from pathlib import Path
from tests.cpp.core_library import loaded
library = loaded(Path(sys.argv[1]))
fault = library.contract_run(sys.argv[2].encode(), sys.argv[3].encode()).decode()
sys.exit(fault or 0)
"""


@pytest.fixture(scope="module")
def contracts(tmp_path_factory):
    """Return the library of the cases, compiled with the whole package and the double."""
    require("g++")
    sources = [*sorted(PACKAGE.glob("src/**/*.cpp")), SOURCE]
    return library_of(sources, tmp_path_factory.mktemp("contracts"))


@pytest.mark.parametrize("case", CASES)
def test_no_call_breaks_a_contract_of_rclcpp(contracts, tmp_path, case):
    """A call that compiles may still raise at run time, such as an empty list of parameters."""
    done = subprocess.run(
        [sys.executable, "-c", RUN, contracts, case, tmp_path],
        cwd=ROOT, env=os.environ, capture_output=True, text=True, timeout=120, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-2000:]


def test_every_case_is_run(contracts):
    """The names are read from the source, before it is compiled."""
    assert loaded(contracts).contract_names().decode().split() == sorted(CASES)


def test_every_call_into_rclcpp_has_its_contract_listed():
    """A call that the table lacks was not compared with the sources of rclcpp."""
    text = "".join(
        re.sub(r"//.*", "", path.read_text())
        for path in (PACKAGE / "src/node.cpp", PACKAGE / "include/rosrm_node_cpp/node.hpp")
    )
    double = "".join(path.read_text() for path in (STUBS / "rclcpp").glob("*.hpp"))
    names = set(re.findall(r"rclcpp::(?:Node::)?(\w+)", text))
    declared = set(re.findall(r"\b(\w+)\(", double))
    called = {one for one in re.findall(r"\b(\w+)(?:<\w+>)?\(", text) if one in declared}
    table = (STUBS / "README.md").read_text()
    missing = {one for one in names | called if f"`{one}`" not in table}
    assert missing - STANDARD == set()
