"""Errors of periodic checkpoints."""

from __future__ import annotations

import errno
import os
import re
import subprocess
import sys

import pytest

from rosrm.errors import CriuError
from rosrm_criu.control.client import control_directory
from rosrm_criu.control.messages import VARIABLE
from rosrm_criu.engine import paths
from rosrm_criu.executors import periodic
from rosrm_criu.executors.freeze import owner_of


def started() -> subprocess.Popen[bytes]:
    """Start a process with a control directory, which waits for the end of its input."""
    control = control_directory("test_criu_periodic_steps", os.geteuid())
    return subprocess.Popen(
        [sys.executable, "-c", "import sys; sys.stdin.read()"], stdin=subprocess.PIPE,
        env={**os.environ, VARIABLE: str(control)},
    )  # fmt: skip


def test_a_directory_that_cannot_be_written_is_named(tmp_path):
    """The error precedes any request to the node."""
    (tmp_path / "images").write_text("in the way")
    with started() as process:
        here = {"host": "a", "state": str(tmp_path), "pids": {"p#1": process.pid}, "instances": []}
        arguments = {
            "process": "p", "source": 1, "destination": 0, "attempt": "x", "timeout": 5.0,
            "here": here, "seconds": {},
        }  # fmt: skip
        with pytest.raises(CriuError, match=r"no image can be made in .*images.*: "):
            periodic.dump(arguments)
        process.communicate()


@pytest.mark.parametrize(
    ("number", "there", "said"),
    [
        (errno.ENOSPC, True, "no image can be made in .*: No space left"),
        (errno.ENOENT, True, "no image can be made in .*: No such file"),
        (errno.ENOENT, False, "was restarted during the checkpoint"),
    ],
)
def test_removed_images_are_no_fault_of_the_disk(tmp_path, number, there, said):
    """A restart by a user removes all images, including one under way."""
    parent = paths.periodic(tmp_path, 1)
    if there:
        parent.mkdir(parents=True)
    error = OSError(number, os.strerror(number))
    assert re.search(said, periodic.why_not_written(parent, error))


def test_the_owner_of_an_ended_process_is_unknown():
    """The error names the pid."""
    with started() as process:
        process.communicate()
    with pytest.raises(CriuError, match=f"process {process.pid} has ended"):
        owner_of(process.pid)
