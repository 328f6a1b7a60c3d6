"""Forks of the supervisor while its threads for files want the interpreter."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import rosrm
from tests.waiting import PATIENCE

#: Forks as into a control group, but without one, while threads wait for the lock of the
#: interpreter. Prints each child that does not end well.
SCRIPT = """
import _thread, os, signal
from rosrm.runtime import file_thread
from rosrm.supervisor import spawn_into

file_thread.let_threads_wait()
spawn_into._CLONE_INTO_CGROUP = 0


def want():
    while True:
        os.stat("/")


for _ in range(3):
    _thread.start_new_thread(want, ())
for _ in range(300):
    sum(range(20_000))
    pid = spawn_into.fork_into(0)
    if not pid:
        signal.alarm(5)
        os.stat("/")
        os._exit(0)
    status = os.waitpid(pid, 0)[1]
    if status:
        print("a child ended with", status)
"""


def test_a_child_never_waits_for_a_thread_of_its_parent():
    """The lock of the interpreter is free in the child, and no thread has asked for it."""
    environment = {**os.environ, "PYTHONPATH": str(Path(rosrm.__file__).parent.parent)}
    script = [sys.executable, "-c", SCRIPT]
    done = subprocess.run(
        script, env=environment, capture_output=True, text=True, timeout=2 * PATIENCE, check=False
    )
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
