"""Checks of `make lint` as tests: import contracts, style and types."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from pathlib import Path

import pytest

import rosrm_checkpoint.plugin
import rosrm_container.plugin
import rosrm_criu.plugin
import rosrm_migration.plugin
import rosrm_scoring.plugin
from rosrm.extensions.registry import Registry

ROOT = Path(__file__).resolve().parents[2]
TOOLS = Path(sys.executable).parent

COMMANDS = {
    "contracts": ["lint-imports"],
    "style": ["ruff", "check", "--quiet", "--output-format=concise"],
    "format": ["ruff", "format", "--check", "--quiet"],
    "types": ["mypy", "--no-error-summary"],
}
#: Attributes of syntax nodes that hold a name: of a variable, attribute, argument or function.
NAMING = ("id", "attr", "arg", "name")


@pytest.mark.parametrize("what", COMMANDS)
@pytest.mark.timeout(300)
def test_repository_keeps(what: str) -> None:
    if what == "types" and sys.version_info < (3, 11):
        pytest.skip(
            "Python 3.10 has no newer numpy than 2.2, whose types are not those checked with"
        )
    tool, *arguments = COMMANDS[what]

    run = subprocess.run(
        [TOOLS / tool, *arguments], cwd=ROOT, capture_output=True, text=True, check=False
    )

    if run.returncode != 0:
        pytest.fail(f"{' '.join(COMMANDS[what])}\n{run.stdout}{run.stderr}", pytrace=False)


def test_a_package_that_lists_its_modules_lists_all_of_them():
    for init in (ROOT / "rosrm").rglob("__init__.py"):
        docstring = ast.get_docstring(ast.parse(init.read_text())) or ""
        listed = set(re.findall(r"\b[a-z]\w*(?:\.py|/)", docstring))
        if any(name.endswith(".py") for name in listed):
            inner = {path.parent for path in init.parent.glob("*/__init__.py")}
            files = {path.name for path in init.parent.glob("[a-z]*.py")}
            assert listed == files | {f"{folder.name}/" for folder in inner}, init


def described(node: ast.AST) -> set[str]:
    """Return the names that the docstring of a class or function describes."""
    sections = re.findall(
        r"^(?:Args|Attributes):\n((?: .*\n)*)", f"{ast.get_docstring(node)}\n", re.MULTILINE
    )
    found = re.findall(r"^    (\w+(?:, \w+)*): ", "".join(sections), re.MULTILINE)
    return {name for names in found for name in names.split(", ")}


def test_docstrings_describe_only_what_exists():
    for part in ("rosrm", "plugins", "tools"):
        for path in (ROOT / part).rglob("*.py"):
            for node in ast.walk(ast.parse(path.read_text())):
                if isinstance(node, ast.ClassDef | ast.FunctionDef):
                    inner = [vars(one) for one in ast.walk(node)]
                    names = {one[key] for one in inner for key in NAMING if key in one}
                    assert described(node) <= names, f"{path}: {node.name}"


def test_no_name_of_a_shipped_plugin_decides_anything():
    """Core, configuration and slave ask for capabilities; the file of defaults alone has names."""
    shipped = Registry.of(
        checkpoint=rosrm_checkpoint.plugin,
        container=rosrm_container.plugin,
        criu=rosrm_criu.plugin,
        migration=rosrm_migration.plugin,
        scoring=rosrm_scoring.plugin,
    )
    kinds = ("migration", "launcher", "scoring", "checkpoint")
    names = {name for kind in kinds for name in shipped.names(kind)}
    assert {"criu", "handoff"} <= names
    found = {
        f"{path.relative_to(ROOT)}:{node.lineno}: {node.value!r}"
        for part in ("core", "config", "extensions", "model", "slave", "supervisor")
        for path in (ROOT / "rosrm" / part).rglob("*.py")
        if path != ROOT / "rosrm/config/settings.py"
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.Constant) and node.value in names
    }
    assert not found
