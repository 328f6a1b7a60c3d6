"""One full file system for state, logs and working directory: the supervisor serves on."""

from __future__ import annotations

import errno
import os
import signal

import pytest

from rosrm.model.values import InstanceState, RestartPolicy
from rosrm.supervisor import own_log
from tests.faults.disks import small_disk
from tests.waiting import command_of, wait_until

#: Its output makes the supervisor write to the index of the log, which fails.
TALKS = "trap 'exit 7' USR1; while :; do echo x; sleep 0.05; done"


@pytest.fixture
def disk(host):
    with small_disk(host.state) as mounted:
        yield mounted


def test_no_supervisor_ends_and_no_exit_code_is_lost(disk, host):
    """The processes write output all the time, so the supervisor has faults to log."""
    client = host.connect()
    pids = []
    for name in ("job", "service"):
        order = host.order(name, "bash", "-c", TALKS, restart=RestartPolicy("never"))
        client.start([order])
        pids.append(host.running(client, name).pid)
    disk.fill()
    for number in range(40):  # the first ones fit into the last page of the record
        status = host.run(client, host.order(f"other{number}", "true"))
    assert "No space left" in status.message
    for name, pid in zip(("job", "service"), pids, strict=True):
        os.kill(pid, signal.SIGUSR1)
        ended = host.ended(client, name)
        assert (ended.state, ended.exit_code) == (InstanceState.FAILED, 7)
    assert str(host.state) in command_of(client.pid)
    disk.make_room()
    wait_until(lambda: host.run(client, host.order("last", "true")), "a start with room")
    assert [one.pid for one in host.clients] == [client.pid]


def test_a_supervisor_starts_on_a_full_disk(disk, host):
    """The new one takes over the processes of the former one, whose record it cannot replace."""
    client = host.connect()
    pid = host.sleeper(client, "sleeps")
    disk.fill()
    client = host.replace_supervisor(client)
    assert [one.pid for one in client.instances] == [pid]
    os.kill(pid, signal.SIGKILL)
    assert host.ended(client, "sleeps").state is InstanceState.FAILED
    assert int((host.state / "supervisor.lock").read_text()) == client.pid


def test_lines_that_cannot_be_written_are_counted(monkeypatch):
    """The log of the supervisor counts lines that find no room; the next line gives the number."""
    written, full = [], [True]

    def write(_file, data):
        if full:
            raise OSError(errno.ENOSPC, "No space left on device")
        written.append(data.decode())
        return len(data)

    monkeypatch.setattr(own_log.os, "write", write)
    own_log.write("first")
    own_log.write("second")
    full.clear()
    own_log.write("third")
    own_log.write("fourth")
    assert "2 lines before this one are missing: No space left on device\nthird" in written[0]
    assert "missing" not in written[1]
