"""A supervisor where a filter refuses system calls, as in old containers and emulators."""

from __future__ import annotations

import errno
import os
import signal

import pytest

from rosrm.core.supervisor.events import StopOrdered
from rosrm.model.values import InstanceState, RestartPolicy
from tests.refused_calls import (
    CLONE3,
    CLOSE_RANGE,
    PIDFD_OPEN,
    PIDFD_SEND_SIGNAL,
    without_calls,
)
from tests.waiting import wait_gone

ALL = (CLONE3, CLOSE_RANGE, PIDFD_OPEN, PIDFD_SEND_SIGNAL)
#: A leader that ends, and leaves a child that ignores SIGINT.
LEAVES = "(trap '' INT; exec sleep 1000) & echo $! > child; exit 0"


@pytest.mark.parametrize("error", [errno.EPERM, errno.ENOSYS])
def test_ends_of_processes_that_were_taken_over_are_found(host, error):
    """Without a pidfd the supervisor looks for the processes in /proc, and does not end."""
    first = host.connect()
    pid = host.sleeper(first, "sleeps", restart=RestartPolicy("always", delay=0.01))
    host.kill_supervisor(first)
    client = without_calls(host.connect, *ALL, error=error)
    os.kill(pid, signal.SIGKILL)
    assert host.running(client, "sleeps").pid != pid
    client.send(StopOrdered(("sleeps", 1)))
    assert host.ended(client, "sleeps").state is InstanceState.EXITED


def test_processes_that_a_leader_leaves_are_stopped(host):
    """The supervisor has not started these processes, and has no pidfd of them either."""
    client = without_calls(host.connect, *ALL)
    client.start([host.order("leaves", "sh", "-c", LEAVES)])
    assert host.ended(client, "leaves").state is InstanceState.EXITED
    wait_gone(int((host.state / "work" / "child").read_text()))
