"""Runs that the client reports as unhealthy: ended, then subject to their restart policy."""

from __future__ import annotations

import os
import signal

import pytest

from rosrm.model.values import InstanceId, InstanceState, RestartPolicy
from tests.waiting import wait_gone

AGAIN = RestartPolicy("on-failure", delay=0.05)


@pytest.mark.parametrize("killed", ["never", "after"])
def test_a_stopped_process_ends_and_starts_again(host, client, killed):
    """The order ends the whole paused tree, which SIGINT cannot reach, and survives a kill."""
    client.start([host.order("hung", "sh", "-c", "sleep 1000; true", restart=AGAIN)])
    pid = host.running(client, "hung").pid
    os.kill(pid, signal.SIGSTOP)
    client.fail(InstanceId("hung", 1), pid, "unhealthy: stopped for 5 s", kill=True)
    if killed == "after":
        host.wait(client, "hung", InstanceState.STOPPING, InstanceState.BACKOFF)
        host.kill_supervisor(client)
        client = host.connect()
        again = [one for one in client.instances if one.pid not in (0, pid)]
    else:
        assert host.wait(client, "hung", InstanceState.BACKOFF).message.startswith("unhealthy: st")
        again = []
    again = again or [host.running(client, "hung")]
    assert again[0].pid != pid
    wait_gone(pid)


def test_a_failed_run_that_exits_well_has_failed(host, client):
    """Without a restart policy the end is final; the status keeps the reason."""
    code = "import time, signal, sys; signal.signal(signal.SIGINT, lambda *_: sys.exit(0)); "
    client.start([host.python("calm", code + "print('up', flush=True); time.sleep(1000)")])
    pid = host.running(client, "calm").pid
    client.fail(InstanceId("calm", 1), pid, "unhealthy: silent", kill=False)
    status = host.ended(client, "calm")
    assert (status.state, status.message) == (InstanceState.FAILED, "unhealthy: silent")
