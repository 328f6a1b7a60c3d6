"""End of the cluster of `rosrm up`: ended parts, logs that cannot be read, foreign processes."""

from __future__ import annotations

import os
import signal
import subprocess
from types import SimpleNamespace

import pytest

from rosrm.cli.up import cluster
from rosrm.cli.up.cluster import PartEnded, StillRunning, UpCluster


def part(log, returncode):
    """Return a slave that has ended."""
    return SimpleNamespace(name="robot", log=log, process=SimpleNamespace(returncode=returncode))


@pytest.mark.parametrize(
    ("returncode", "how"),
    [(3, "exit code 3"), (-9, "killed by SIGKILL"), (-35, "killed by signal 35")],
)
def test_the_error_of_an_ended_part_says_how_it_ended(tmp_path, returncode, how):
    """Each return code has a phrase, also that of a real-time signal, which has no name."""
    log = tmp_path / "slave.log"
    log.write_bytes(b"last \xff words\n")
    error = cluster._error_of(part(log, returncode))
    assert isinstance(error, PartEnded)
    assert f"the slave of robot has ended ({how})" in str(error)
    assert "last \N{REPLACEMENT CHARACTER} words" in str(error)


def test_a_log_that_cannot_be_read_hides_no_ended_part(tmp_path):
    """The error says that the part has ended, and why the log has no lines."""
    error = cluster._error_of(part(tmp_path, 1))  # a directory, whose bytes cannot be read
    assert isinstance(error, PartEnded)
    assert "has ended (exit code 1)" in str(error)
    assert "Is a directory" in str(error)


def test_a_process_of_another_user_is_named_and_hides_no_other(tmp_path, monkeypatch):
    """All processes get the signal; the error names those that stay, with the reason."""
    signalled = []

    def kill(pid, number):
        signalled.append(pid)
        if pid == 11:
            raise PermissionError(1, os.strerror(1))

    up = UpCluster(tmp_path)
    monkeypatch.setattr(os, "kill", kill)
    monkeypatch.setattr(cluster, "_END", 0.0)
    monkeypatch.setattr(up, "_left", lambda: {11: "root's", 12: "ours"})
    with pytest.raises(StillRunning) as raised:
        up._end_others(signal.SIGKILL)
    assert signalled == [11, 12]
    assert "root's (pid 11: Operation not permitted) and ours (pid 12)" in str(raised.value)


def test_a_killed_cleaner_does_not_replace_the_error_of_an_ended_part(tmp_path, monkeypatch):
    """The message to the killed cleaner fails; the user still gets the first error."""
    programs = []

    class Noted(subprocess.Popen):
        def __init__(self, *arguments, **options):
            super().__init__(*arguments, **options)
            programs.append(self)

    monkeypatch.setattr(subprocess, "Popen", Noted)

    def run():
        with cluster.cleaned(tmp_path / "state", keep=False):
            programs[0].kill()
            programs[0].wait(10.0)
            raise PartEnded("the slave has ended")

    with pytest.raises(PartEnded):
        run()
