"""Errors of a look at a file: only some of them tell that it does not exist."""

from __future__ import annotations

import ast
import errno
import os
from pathlib import Path

import pytest

from rosrm.shortage import exists, is_directory, is_file, names, status, tree

ROOT = Path(__file__).resolve().parents[2]
#: Parts that end, delete, overwrite or restart something where a file does not exist.
PARTS = ("rosrm/supervisor", "rosrm/slave", "plugins")
#: Texts alone depend on it here.
TEXTS = {ROOT / "rosrm/supervisor/exec_failures.py"}
#: Functions of `os.path`, and methods of `pathlib.Path`, that are False after any error.
SWALLOWING = {"exists", "lexists", "isdir", "isfile", "islink", "ismount", "is_dir", "is_file",
              "is_symlink", "is_mount", "is_socket", "is_fifo", "glob", "rglob"}  # fmt: skip
#: Functions of the plugins to which each `OSError` may mean the same, with the reason.
ALIKE = {
    "rosrm_container/start.py: _copy_key": "podman names the missing file, and a start follows",
    "rosrm_criu/control/directory.py: remove_directory": "a rest is empty, and harmless",
    "rosrm_criu/control/messages.py: edition_of_request": "the node looks again at once",
    "rosrm_criu/control/messages.py: remove_messages": "an old message answers no new request",
    "rosrm_criu/engine/binary.py: _wait_for_end": "it polls instead",
    "rosrm_criu/engine/dump.py: dump": "the error to report is the first one",
    "rosrm_criu/engine/external_resources.py: _is_device": "a text alone depends on it",
    "rosrm_criu/engine/external_resources.py: program": "a text alone depends on it",
    "rosrm_criu/engine/image.py: link_or_copy": "the copy raises the same error",
    "rosrm_criu/engine/memory_copy.py: _pieces": "the dump has the pages that the copy lacks",
    "rosrm_criu/engine/probe.py: setcap_command": "a text alone depends on it",
    "rosrm_criu/engine/shim.py: _fail": "the end of the shim tells the same",
    "rosrm_criu/engine/shim.py: _reopened_log": "another descriptor of the same file does",
    "rosrm_criu/engine/shim.py: _restore_as_child": "the guard has ended",
    "rosrm_criu/executors/precopy.py: put_in_place": "the check of the image names the file",
    "rosrm_criu/transfer/landing.py: _remove_stale": "it stays until the next fetch",
}
#: Files of the plugins with errors of connections alone, each of which ends the connection.
OF_CONNECTIONS = ("receiving.py", "sending.py", "starting.py")


def test_what_is_there_is_told_by_its_kind(tmp_path):
    (tmp_path / "file").touch()
    (tmp_path / "link").symlink_to("nowhere")
    assert (exists(tmp_path), is_directory(tmp_path), is_file(tmp_path)) == (True, True, False)
    file = tmp_path / "file"
    assert (exists(file), is_directory(file), is_file(str(file))) == (True, False, True)
    assert not exists(tmp_path / "link")
    assert status(tmp_path / "link", follow_symlinks=False) is not None


def test_a_directory_has_names_and_a_tree(tmp_path):
    (tmp_path / "a/b").mkdir(parents=True)
    (tmp_path / "a/b/c").touch()
    (tmp_path / "a/up").symlink_to("..")
    assert names(tmp_path) == ["a"]
    assert names(tmp_path / "none") == []
    assert sorted(tree(tmp_path)) == [f"{tmp_path}/{one}" for one in ("a", "a/b", "a/b/c", "a/up")]


def test_what_no_path_can_name_is_absent(tmp_path):
    (tmp_path / "file").touch()
    (tmp_path / "loop").symlink_to("loop")
    for path in ("none", "file/below", "loop", "a\0b"):
        assert not exists(tmp_path / path)


@pytest.mark.parametrize("number", [errno.ENOMEM, errno.EACCES, errno.EIO, errno.ESTALE])
@pytest.mark.parametrize("ask", [exists, is_directory, is_file, names])
def test_any_other_error_is_no_absence(tmp_path, monkeypatch, number, ask):
    def fail(*_, **__):
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(os, "stat", fail)
    monkeypatch.setattr(os, "listdir", fail)
    with pytest.raises(OSError, match=os.strerror(number)):
        ask(tmp_path)


def test_no_part_takes_an_error_for_an_absence():
    """They ask `rosrm.shortage`, or call the file and expect FileNotFoundError."""
    found = {
        f"{path.relative_to(ROOT)}:{node.lineno}: {node.func.attr}"
        for part in PARTS
        for path in sorted((ROOT / part).rglob("*.py"))
        if path not in TEXTS
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute)
        if node.func.attr in SWALLOWING
        # an entry of `os.scandir` raises any other error
        if not any(word.arg == "follow_symlinks" for word in node.keywords)
    }
    assert not found


def _exceptions(clause: ast.expr | None) -> list[str]:
    """Return the names in an `except` clause."""
    return [ast.unparse(one) for one in getattr(clause, "elts", [clause]) if one]


def _takes_all_alike(node: ast.AST) -> bool:
    """Return True for code that neither raises an `OSError`, nor looks at it, nor reports it."""
    if isinstance(node, ast.Call):
        return ast.unparse(node.func).endswith("suppress") and "OSError" in map(
            ast.unparse, node.args
        )
    if not isinstance(node, ast.ExceptHandler) or "OSError" not in _exceptions(node.type):
        return False
    body = [one for line in node.body for one in ast.walk(line)]
    reports = any(isinstance(one, ast.Name) and one.id == node.name for one in body)
    return not reports and not any(isinstance(one, ast.Raise) for one in body)


def _alike(tree: ast.AST, function: str = "") -> set[str]:
    """Return the functions with such code."""
    found = set()
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.FunctionDef):
            found |= _alike(node, node.name)
            continue
        found |= _alike(node, function)
        if _takes_all_alike(node):
            found.add(function)
    return found


def test_plugins_take_no_error_for_an_absence():
    """Their handlers call `raise_shortage`, or expect FileNotFoundError or ProcessLookupError."""
    plugins = ROOT / "plugins"
    found = {
        f"{path.relative_to(plugins / path.relative_to(plugins).parts[0])}: {function}"
        for path in sorted(plugins.rglob("*.py"))
        if path.name not in OF_CONNECTIONS
        for function in _alike(ast.parse(path.read_text(encoding="utf-8")))
    }
    assert found == set(ALIKE)
