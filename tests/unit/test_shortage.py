"""Errors of a look at a file: only some of them tell that it does not exist."""

from __future__ import annotations

import ast
import errno
import os
from pathlib import Path

import pytest

from rosrm.shortage import exists, is_directory, is_file, status

ROOT = Path(__file__).resolve().parents[2]
#: Parts that end, delete, overwrite or restart something where a file does not exist.
PARTS = ("supervisor", "slave")
#: Texts alone depend on it here.
TEXTS = {ROOT / "rosrm/supervisor/exec_failures.py"}
#: Functions of `os.path`, and methods of `pathlib.Path`, that are False after any error.
SWALLOWING = {"exists", "lexists", "isdir", "isfile", "islink", "ismount", "is_dir", "is_file",
              "is_symlink", "is_mount", "is_socket", "is_fifo", "glob", "rglob"}  # fmt: skip


def test_what_is_there_is_told_by_its_kind(tmp_path):
    (tmp_path / "file").touch()
    (tmp_path / "link").symlink_to("nowhere")
    assert (exists(tmp_path), is_directory(tmp_path), is_file(tmp_path)) == (True, True, False)
    file = tmp_path / "file"
    assert (exists(file), is_directory(file), is_file(str(file))) == (True, False, True)
    assert not exists(tmp_path / "link")
    assert status(tmp_path / "link", follow_symlinks=False) is not None


def test_what_no_path_can_name_is_absent(tmp_path):
    (tmp_path / "file").touch()
    (tmp_path / "loop").symlink_to("loop")
    for path in ("none", "file/below", "loop", "a\0b"):
        assert not exists(tmp_path / path)


@pytest.mark.parametrize("number", [errno.ENOMEM, errno.EACCES, errno.EIO, errno.ESTALE])
@pytest.mark.parametrize("ask", [exists, is_directory, is_file])
def test_any_other_error_is_no_absence(tmp_path, monkeypatch, number, ask):
    def fail(*_, **__):
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(os, "stat", fail)
    with pytest.raises(OSError, match=os.strerror(number)):
        ask(tmp_path)


def test_supervisor_and_slave_take_no_error_for_an_absence():
    """They ask `rosrm.shortage`, or call the file and expect FileNotFoundError."""
    found = {
        f"{path.relative_to(ROOT)}:{node.lineno}: {node.func.attr}"
        for part in PARTS
        for path in sorted((ROOT / "rosrm" / part).rglob("*.py"))
        if path not in TEXTS
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute)
        if node.func.attr in SWALLOWING
        # an entry of `os.scandir` raises any other error
        if not any(word.arg == "follow_symlinks" for word in node.keywords)
    }
    assert not found
