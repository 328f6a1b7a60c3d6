"""The lock of a state directory: held by one process, and not by what its plugins leave."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from rosrm.errors import Refused
from rosrm.runtime.state_lock import only_one

PROGRAM = """
import os, sys, time
from pathlib import Path
from rosrm.runtime.state_lock import only_one
with only_one(Path(sys.argv[1]), "slave", code="c", remedy=""):
    fork = os.fork() if sys.argv[2] == "python" else __import__("ctypes").CDLL(None).fork()
    if fork == 0:
        time.sleep(60.0)
        os._exit(0)
    print(fork, flush=True)
    os._exit(0)
"""


@pytest.fixture(params=["python", "c"])
def child(request: pytest.FixtureRequest, tmp_path: Path):
    """Yield the way and the pid of a child that a part has left."""
    with (tmp_path / "output").open("w") as output:
        process = subprocess.Popen(
            [sys.executable, "-c", PROGRAM, tmp_path / "state", request.param], stdout=output
        )
        process.wait(60.0)
    pid = int((tmp_path / "output").read_text())
    yield request.param, pid
    os.kill(pid, signal.SIGKILL)


def test_a_child_that_a_plugin_has_left_does_not_hold_the_lock(child, tmp_path: Path) -> None:
    """The next part starts; a child forked in C, unseen by Python, is named in the error."""
    how, pid = child
    if how == "python":
        with only_one(tmp_path / "state", "slave", code="c", remedy=""):
            return
    with (
        pytest.raises(Refused, match=rf"has ended .* holds its lock: pid {pid}\."),
        only_one(tmp_path / "state", "slave", code="c", remedy=""),
    ):
        pass


def test_a_second_part_is_refused_with_the_pid_of_the_first(tmp_path: Path) -> None:
    """The message names the process that runs."""
    with (
        only_one(tmp_path, "slave", code="c", remedy="another `state:`"),
        pytest.raises(Refused, match=f"a slave runs already on .*: pid {os.getpid()}"),
        only_one(tmp_path, "slave", code="c", remedy="another `state:`"),
    ):
        pass
