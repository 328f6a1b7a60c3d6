"""Public names: content of `import rosrm`, its cost, and users of private names."""

from __future__ import annotations

import ast
import pydoc
import re
import subprocess
import sys
from pathlib import Path

import pytest

import rosrm
from rosrm import shortage
from tests.pages import PYTHON, ROOT, blocks, run_examples

#: Modules with public names of their own.
PUBLIC = ("rosrm.node", "rosrm.shortage", "rosrm.testing")
#: Programs of this repository that need more names.
MORE = {
    "plugins/migration/rosrm_migration/handoff.py": {"rosrm.ros.slave.publisher_watch"},
    "examples/rosrm_examples/demo_job.py": {"rosrm.config.settings"},
    "examples/rosrm_examples/demo_run.py": {"rosrm.supervisor.client"},
    "examples/rosrm_examples/demo_screen.py": {"rosrm.cli.output.top"},
    "examples/rosrm_examples/migration_job.py": {"rosrm.config.settings"},
    "examples/rosrm_examples/rollout_job.py": {"rosrm.config.settings"},
}
PROGRAMS = [
    path
    for folder in ("plugins", "examples", "rosrm/cli/templates")
    for path in sorted((ROOT / folder).rglob("*.py"))
]
#: rosrm-criu also uses modules of the parts that it works in: slave, supervisor, node and command.
CRIU = ROOT / "plugins" / "criu"
OF_CRIU = {
    "rosrm.cli.options",
    "rosrm.cli.output",
    "rosrm.errors",
    "rosrm.model.codec",
    "rosrm.ros",
    "rosrm.ros.fast_dds",
    "rosrm.ros.graph_remains",
    "rosrm.ros.names",
    "rosrm.ros.peer_announcements",
    "rosrm.runtime",
    "rosrm.runtime.disk_space",
    "rosrm.runtime.log_tail",
    "rosrm.runtime.signalling",
    "rosrm.supervisor",
    "rosrm.supervisor.procfs",
    "rosrm.supervisor.spawn",
    "rosrm.supervisor.spawn_error",
    "rosrm.wording",
}
PAGES = [
    "docs/tutorials/your-own-scoring-plugin.md",
    "docs/tutorials/your-own-migration-strategy.md",
    "docs/tutorials/your-own-filter.md",
    "docs/tutorials/your-own-probe.md",
    "docs/tutorials/your-own-checkpoint-policy.md",
    "docs/reference/plugins.md",
    "docs/how-to/stateful-node.md",
    "docs/how-to/portable-node.md",
    PYTHON,
]


def run(code: str) -> str:
    """Run code in the interpreter of the supervisor: isolated, without installed packages."""
    path = f"import sys; sys.path.insert(0, {str(ROOT)!r})\n"
    words = [sys.executable, "-I", "-S", "-c", path + code]
    return subprocess.run(words, capture_output=True, text=True, check=True).stdout


def imported(code: str) -> set[str]:
    """Return the modules of rosrm that code imports, in functions too."""
    found = set()
    for node in ast.walk(ast.parse(code)):
        if isinstance(node, ast.ImportFrom) and node.module:
            found.add(node.module)
        elif isinstance(node, ast.Import):
            found |= {one.name for one in node.names}
    return {name for name in found if name.split(".")[0] == "rosrm"}


def private(code: str) -> set[str]:
    return {name for name in imported(code) if name != "rosrm" and not name.startswith(PUBLIC)}


def test_the_lists_of_names_agree():
    """Type checkers read the imports and `__all__`, and the program reads the modules of names."""
    tree = ast.parse(Path(rosrm.__file__).read_text(encoding="utf-8"))
    (static,) = (node for node in tree.body if isinstance(node, ast.If))
    imports = {one.name: node.module for node in static.body for one in node.names}
    assert imports == {name: f"rosrm.{module}" for name, module in rosrm._MODULES.items()}
    assert set(rosrm.__all__) == {*imports, "__version__", "PROTOCOL_VERSION"}
    assert len(rosrm.__all__) == len(set(rosrm.__all__))


def test_every_name_is_there_and_in_the_help():
    for name in rosrm.__all__:
        assert getattr(rosrm, name) is not None
        assert name in dir(rosrm)
        assert re.search(rf"\b{name}\b", rosrm.__doc__), f"{name} is not in rosrm.__doc__"


def test_the_types_of_arrays_are_types():
    """A plugin may use them in an expression, as `FloatArray | None` is."""
    assert (rosrm.FloatArray | rosrm.BoolArray | None).__args__[-1] is type(None)


def test_an_unknown_name_is_an_attribute_error():
    with pytest.raises(AttributeError, match="module 'rosrm' has no attribute 'Cleint'"):
        _ = rosrm.Cleint


def test_importing_rosrm_loads_nothing_but_the_version():
    """The supervisor imports rosrm too, and has to stay small."""
    code = "import typing; before = set(sys.modules); import rosrm; "
    code += "print(*sorted(set(sys.modules) - before))"
    assert run(code).split() == ["rosrm", "rosrm.version"]


def test_the_help_needs_no_ros_and_begins_with_the_groups_of_names(monkeypatch):
    """An environment may have rosrm alone."""
    for module in ("rclpy", "rosrm_msgs"):
        monkeypatch.setitem(sys.modules, module, None)
    text = pydoc.render_doc(rosrm, renderer=pydoc.plaintext)
    assert text.index("The public names, by purpose:") < text.index("CLASSES")
    assert "class Client(" in text


@pytest.mark.parametrize("path", PROGRAMS, ids=lambda path: str(path.relative_to(ROOT)))
def test_plugins_and_examples_import_public_names_alone(path):
    found = private(path.read_text(encoding="utf-8"))
    if path.is_relative_to(CRIU):
        assert found <= OF_CRIU
    else:
        assert found == MORE.get(str(path.relative_to(ROOT)), set())


def test_rosrm_criu_uses_each_of_its_modules():
    used = (private(path.read_text(encoding="utf-8")) for path in CRIU.rglob("*.py"))
    assert set().union(*used) == OF_CRIU


@pytest.mark.parametrize("page", PAGES)
def test_pages_import_public_names_alone(page):
    shown = [block.text for block in blocks(page) if block.language == "python"]
    shown += [
        "\n".join(re.findall(r"^>>> ((?:from|import) .*)$", block.text, re.MULTILINE))
        for block in blocks(page)
        if block.language == "pycon"
    ]
    assert shown
    assert set().union(*map(private, shown)) == set()


def test_the_page_has_every_public_name_and_no_other():
    text = (ROOT / PYTHON).read_text(encoding="utf-8").partition("\n## All names\n")[2]
    cells = re.findall(r"^\| (`[^|]*`) \|", text, re.MULTILINE)
    named = [name for cell in cells for name in re.findall(r"`(\w+)`", cell)]
    assert sorted(named) == sorted(rosrm.__all__)


def test_the_page_has_every_name_of_the_shortage():
    text = (ROOT / PYTHON).read_text(encoding="utf-8").partition("\n## All names\n")[0]
    table = text.partition("\n## Looks at files\n")[2]
    cells = re.findall(r"^\| (`[^|]*`) \|", table, re.MULTILINE)
    named = [name for cell in cells for name in re.findall(r"`(\w+)", cell)]
    assert sorted(named) == sorted(shortage.__all__)


def test_the_page_has_every_method_and_argument_of_the_client():
    text = (ROOT / PYTHON).read_text(encoding="utf-8")
    methods = [name for name in vars(rosrm.Client) if not name.startswith("_")]
    missing = [name for name in methods if not re.search(rf"`{name}\(", text)]
    assert missing == ["log_readers"]  # for the command line, which merges logs


def test_the_examples_without_a_cluster_do_what_the_page_shows():
    run_examples(PYTHON, "")
