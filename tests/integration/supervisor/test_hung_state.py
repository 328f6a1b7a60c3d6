"""A state directory or log folder that does not answer: only new starts fail."""

from __future__ import annotations

import itertools
import os
import signal

import pytest

from rosrm.core.supervisor.events import ContactReported, ShutdownOrdered, StopOrdered
from rosrm.model.values import Fence, InstanceState, RestartPolicy
from rosrm.supervisor import instance_record
from rosrm.supervisor.client import SupervisorEnded
from tests.hung_files import hung_files
from tests.waiting import PATIENCE, wait_gone, wait_until

NEVER = RestartPolicy("never")


@pytest.fixture(params=["state", "logs"])
def hung(request, host, tmp_path):
    """Return a file system with the state directory or the log folder, and answer at the end."""
    with hung_files(tmp_path / "hung") as files:
        if request.param == "state":
            host.state = files.place / "state"
        else:
            host.state.mkdir(mode=0o700)
            (host.state / "logs").symlink_to(files.place)
        yield files
        files.answer()
        host.clean_up()


def phases_in_record(host) -> dict[str, str]:
    recorded = instance_record.read(str(host.state))
    return {key[0]: one.phase for key, one in recorded.instances.items()}


def test_what_runs_is_watched_cancelled_and_recorded_later(host, hung):
    """Ends and stops are reported while the directory hangs; a start waits, and works then."""
    client = host.connect()
    pids = {name: host.sleeper(client, name, restart=NEVER) for name in ("ends", "stops", "runs")}
    client.start([host.order("writes", "sh", "-c", "while :; do echo x; sleep 0.05; done")])
    host.running(client, "writes")
    hung.hang()
    os.kill(pids["ends"], signal.SIGKILL)
    assert host.ended(client, "ends").exit_signal == signal.SIGKILL
    client.send(StopOrdered(("stops", 1)))
    assert host.ended(client, "stops").state is InstanceState.EXITED
    client.start([host.order("later", "sleep", "1000", working_directory="/")])
    host.wait(client, "later", InstanceState.STARTING)
    wait_until(lambda: hung.unanswered, "a request")
    hung.answer()
    assert host.running(client, "later").pid
    assert host.sleeper(client, "another")
    found = {"ends": "failed", "stops": "exited", "runs": "running", "later": "running"}
    wait_until(lambda: found.items() <= phases_in_record(host).items(), "all is recorded")


def test_a_start_fails_with_the_reason_and_another_one_at_once(host, hung):
    """A process that a user cancels before that ends at once."""
    client = host.connect()
    host.sleeper(client, "runs")
    hung.hang()
    client.start([host.order(name, "true", restart=NEVER) for name in ("waits", "cancelled")])
    host.wait(client, "waits", InstanceState.STARTING)
    client.send(StopOrdered(("cancelled", 1)))
    assert host.ended(client, "cancelled").state is InstanceState.EXITED
    failed = host.ended(client, "waits")
    assert failed.state is InstanceState.FAILED
    assert "STATE" in failed.message
    assert "does not answer (10 s)" in failed.message
    failed = host.run(client, host.order("next", "true", restart=NEVER))
    assert "does not answer" in failed.message
    hung.answer()
    orders = (host.order("last", "true", number=number) for number in itertools.count(1))
    wait_until(
        lambda: host.run(client, next(orders)).state is InstanceState.EXITED,
        "a start after the answer",
    )


def test_a_fence_acts_while_the_directory_hangs(host, hung):
    client = host.connect()
    host.sleeper(client, "fenced", fence=Fence(1.0, 0.3))
    host.sleeper(client, "runs")
    hung.hang()
    client.send(ContactReported(0.1))
    assert "fence" in host.ended(client, "fenced").message


def test_a_shutdown_ends_and_another_supervisor_may_follow(host, hung):
    """The supervisor ends all processes, and reports that to the slave."""
    client = host.connect()
    pid = host.sleeper(client, "runs")
    hung.hang()
    client.start([host.order("waits", "sleep", "1000")])
    wait_until(lambda: hung.unanswered, "a request")
    client.send(ShutdownOrdered())
    wait_gone(pid)
    with pytest.raises(SupervisorEnded):
        list(iter(lambda: client.receive(PATIENCE), []))
    hung.answer()
    wait_gone(client.pid)
    assert host.sleeper(host.connect(), "next")
