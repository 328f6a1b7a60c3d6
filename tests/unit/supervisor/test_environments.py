"""Environments of real processes in /proc, including those in the middle of an execve."""

from __future__ import annotations

import os
import subprocess

import pytest

from rosrm.supervisor.procfs import read_environment, read_marks

#: On one processor 298 of 300 starts were seen in the middle of their execve.
STARTS = 20


@pytest.fixture
def one_processor():
    """Pin this process to one processor.

    The parent then runs again before the child's execve has ended.
    """
    allowed = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {min(allowed)})
    yield
    os.sched_setaffinity(0, allowed)


def test_the_marks_of_a_process_are_read_in_the_middle_of_its_execve(one_processor):
    marks = {"ROSRM_INSTANCE": "p#1", "ROSRM_SUPERVISOR": "/state"}
    for _ in range(STARTS):
        process = subprocess.Popen(["sleep", "60"], env={**os.environ, **marks})
        try:
            assert read_marks(process.pid) == ("p#1", "/state")
        finally:
            process.kill()
            process.wait()


def test_a_process_without_an_environment_is_not_waited_for(one_processor):
    """An empty environment differs from one that an execve has not yet set."""
    process = subprocess.Popen(["/bin/sleep", "60"], env={})
    try:
        assert read_environment(process.pid) == [b""]
    finally:
        process.kill()
        process.wait()


def test_the_environment_of_a_process_that_has_ended_cannot_be_read():
    with subprocess.Popen(["true"]) as process:
        os.waitid(os.P_PID, process.pid, os.WEXITED | os.WNOWAIT)
        with pytest.raises(OSError, match=r"No such (process|file)"):
            read_environment(process.pid)
