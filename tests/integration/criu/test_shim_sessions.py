"""Shims in the table of sessions; no CRIU is needed."""

import os
import sys
from pathlib import Path

import pytest

from rosrm.extensions.contracts import LauncherContext
from rosrm.extensions.made import MadeLauncher
from rosrm.slave.launch.launchers import Launchers
from rosrm.slave.sessions import SessionTable
from rosrm_criu.launcher import CriuLauncher
from tests.waiting import wait_until

#: Starts a child in another session, and waits for it.
PROGRAM = """
import subprocess
subprocess.run(["sleep", "60"], start_new_session=True)
"""
ROUNDS = 5
LAUNCHER = CriuLauncher(LauncherContext(Path("/nowhere"), sys.executable, 1))
BY_CRIU = Launchers({"criu": MadeLauncher(LAUNCHER, ())})


@pytest.fixture
def spawn(tmp_path):
    """Return a function that starts the program under a name; end it and its child later."""
    pids = []

    def start(name):
        program = tmp_path / name
        program.parent.mkdir(parents=True, exist_ok=True)
        program.write_text(PROGRAM)
        words = [sys.executable, "-I", "-S", str(program)]
        pids.append(os.posix_spawn(sys.executable, words, os.environ, setsid=True))
        return pids[-1]

    yield start
    for pid in pids:
        os.kill(child_of(pid), 9)
        os.waitpid(pid, 0)


def child_of(pid):
    """Return the child of a process once it leads its own session."""

    def leader():
        with open(f"/proc/{pid}/task/{pid}/children") as file:  # noqa: PTH123 - one read
            children = [int(child) for child in file.read().split()]
        return [child for child in children if os.getsid(child) == child]

    return wait_until(leader, f"a session below process {pid}")[0]


def test_a_shim_is_known_as_one_however_early_it_was_added(spawn):
    """A shim is recognised even if it was added before its execve set the command line."""
    table = SessionTable(launchers=BY_CRIU)
    for _ in range(ROUNDS):
        shim = spawn("plugins/criu/rosrm_criu/engine/shim.py")
        table.add(shim)
        child = child_of(shim)
        table.refresh(0.0)
        assert table.members(shim) == (shim, child)
        assert child in table.known_as(shim)


def test_of_any_other_program_a_daemon_is_no_member(spawn):
    """A daemon of any other program is no member, even if the program was added as early."""
    table = SessionTable(launchers=BY_CRIU)
    for _ in range(ROUNDS):
        other = spawn("other.py")
        table.add(other)
        child_of(other)
        table.refresh(0.0)
        assert table.members(other) == (other,)
