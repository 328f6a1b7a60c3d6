"""What goes wrong with a periodic checkpoint is said in words."""

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
    """A process with a place where it is spoken to, and that does nothing; stdin holds it."""
    control = control_directory("test_criu_periodic_steps", os.geteuid())
    return subprocess.Popen(
        [sys.executable, "-c", "import sys; sys.stdin.read()"], stdin=subprocess.PIPE,
        env={**os.environ, VARIABLE: str(control)},
    )  # fmt: skip


def test_a_place_that_cannot_be_written_is_named(tmp_path):
    """It is said before the node is asked for anything."""
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
def test_images_that_were_taken_away_are_no_fault_of_the_disk(tmp_path, number, there, said):
    """Who restarts a process by hand has its images removed, also one that is just being made."""
    parent = paths.periodic(tmp_path, 1)
    if there:
        parent.mkdir(parents=True)
    error = OSError(number, os.strerror(number))
    assert re.search(said, periodic.why_not_written(parent, error))


def test_a_process_that_has_ended_is_called_so():
    """Whoever asks for its owner."""
    with started() as process:
        process.communicate()
    with pytest.raises(CriuError, match=f"process {process.pid} has ended"):
        owner_of(process.pid)
