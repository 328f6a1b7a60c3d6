"""Reasons of errors in texts for users."""

from __future__ import annotations

import ast
import errno
import os
from pathlib import Path

import pytest

from rosrm.wording import reason_of

ROOT = Path(__file__).parents[2]
#: The one place, and a file that imports the standard library alone.
MAY_READ = {"rosrm/wording.py", "tools/lab/rosrm_lab/inside/relay.py"}


@pytest.mark.parametrize(
    ("error", "reason"),
    [
        (OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), "/a"), "No space left on device"),
        (TimeoutError("timed out"), "timed out"),
        (ValueError("embedded null byte"), "embedded null byte"),
        (OSError(), "OSError"),
    ],
)
def test_the_reason_of_an_error_is_never_missing(error, reason):
    """An `OSError` with a text alone, such as the time-out of a socket, has no `strerror`."""
    assert reason_of(error) == reason


def test_no_text_has_the_reason_of_an_error_that_may_be_none():
    """`strerror` is read in one place; elsewhere a text would say "cannot be read: None"."""
    found = [
        f"{name}:{node.lineno}"
        for folder in ("rosrm", "plugins", "tools")
        for path in sorted((ROOT / folder).rglob("*.py"))
        if (name := str(path.relative_to(ROOT))) not in MAY_READ
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.Attribute) and node.attr == "strerror"
        if not (isinstance(node.value, ast.Name) and node.value.id == "os")
    ]
    assert not found, "use rosrm.wording.reason_of"
