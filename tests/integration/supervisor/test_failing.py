"""A run that its client has found unhealthy is ended, and its restart policy goes on from there."""

from __future__ import annotations

import os
import signal

import pytest

from rosrm.model.values import InstanceId, InstanceState, RestartPolicy

from .conftest import wait_gone

AGAIN = RestartPolicy("on-failure", delay=0.05)


@pytest.mark.parametrize("killed", ["never", "after"])
def test_a_stopped_process_ends_and_starts_again(host, client, killed):
    """SIGSTOP lets no SIGINT through; the order reaches all of it, and survives the supervisor."""
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
    """Without a restart policy its end is final; the reason stays readable."""
    code = "import time, signal, sys; signal.signal(signal.SIGINT, lambda *_: sys.exit(0)); "
    client.start([host.python("calm", code + "print('up', flush=True); time.sleep(1000)")])
    pid = host.running(client, "calm").pid
    client.fail(InstanceId("calm", 1), pid, "unhealthy: silent", kill=False)
    status = host.ended(client, "calm")
    assert (status.state, status.message) == (InstanceState.FAILED, "unhealthy: silent")
