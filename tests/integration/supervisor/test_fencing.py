"""Fences of real processes while slave and supervisor are paused or killed."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import textwrap
import time
from pathlib import Path

import pytest

import rosrm
from rosrm.core.supervisor.events import ContactReported
from rosrm.model.values import Fence, InstanceId, InstanceState, RestartPolicy, StopPolicy
from rosrm.supervisor.client_values import key_of
from rosrm.supervisor.messages import Remember
from tests.waiting import PATIENCE, holds_for, wait_gone, wait_until

SLEEPS = ("sleep", "1000")
DEAF = ("sh", "-c", "trap '' INT TERM; echo deaf; (trap '' INT TERM; sleep 1000) & wait; wait")
ONE = InstanceId("one", 1)
ALWAYS = RestartPolicy("always", delay=0.05)

#: A slave that renews the lease continually, with a fenced singleton and an unfenced driver.
SLAVE = """
    import os, sys, time
    from pathlib import Path
    from rosrm.core.supervisor.events import ContactReported
    from rosrm.model.values import Fence, InstanceId
    from rosrm.supervisor.client_values import LaunchOrder
    from rosrm.supervisor.client import SupervisorClient
    client = SupervisorClient.connect(Path(sys.argv[1]))
    fences = {"one": Fence(3.0, 0.5), "driver": None}
    client.start([
        LaunchOrder(InstanceId(name, 1), ("sleep", "1000"), dict(os.environ), fence=fence)
        for name, fence in fences.items()
    ])
    pids = {}
    while True:
        client.send(ContactReported(time.monotonic(), 0.0))
        for status in client.receive(0.1):
            if status.pid and status.instance.process not in pids:
                pids[status.instance.process] = status.pid
                if len(pids) == 2:
                    print(client.pid, pids["one"], pids["driver"], flush=True)
"""


@pytest.fixture
def slave(host):
    root = str(Path(rosrm.__file__).parent.parent)
    slave = subprocess.Popen(
        [sys.executable, "-c", textwrap.dedent(SLAVE), str(host.state)],
        stdout=subprocess.PIPE, env={**os.environ, "PYTHONPATH": root},
    )  # fmt: skip
    yield slave
    slave.kill()
    slave.wait()
    slave.stdout.close()


def alive(pid: int) -> bool:
    return Path(f"/proc/{pid}").exists()


def of_one(client):
    return next(status for status in client.instances if status.instance == ONE)


def test_a_stopped_slave_cannot_fence_so_its_supervisor_does(host, slave):
    """With a paused slave, the fenced instance ends in time; the one without a fence runs on."""
    supervisor, one, driver = map(int, slave.stdout.readline().split())
    host.pids.add(supervisor)
    os.kill(slave.pid, signal.SIGSTOP)
    stopped = time.monotonic()
    wait_gone(one)
    took = time.monotonic() - stopped
    assert 1.5 < took < PATIENCE / 2, took  # the last renewal was 0.1 s before, on a quiet machine
    assert alive(driver)
    slave.kill()
    slave.wait()
    client = host.connect(start=False)
    assert of_one(client).state is InstanceState.FENCED
    assert of_one(client).message.startswith("fenced: no confirmed contact with the master for 3 s")


def test_one_that_counts_on_its_slave_goes_on_while_that_is_at_work(host, client):
    """A fence with `alive` is renewed by the slave's sign of life alone, and ends without it."""
    fences = {"one": Fence(2.0, 0.0, alive=True), "two": Fence(2.0, 0.0)}
    client.start([host.order(name, *SLEEPS, fence=fence) for name, fence in fences.items()])
    host.running(client, "one")
    until, told = time.monotonic() + 5.0, []
    while time.monotonic() < until:
        alive = time.monotonic()
        client.send(ContactReported(0.0, alive))
        told += client.receive(0.1)
    assert {status.instance.process for status in told if status.state.ended} == {"two"}
    status = host.ended(client, "one")
    assert time.monotonic() - alive >= 2.0
    assert "no activity of its slave" in status.message


def test_all_of_it_ends_within_its_grace(host, client):
    """An instance deaf to SIGINT and SIGTERM ends by SIGKILL, with its child, within the fence."""
    graces = StopPolicy(interrupt_grace=500.0, terminate_grace=500.0)
    client.start([host.order("one", *DEAF, fence=Fence(2.0, 0.5), stop=graces)])
    host.running(client, "one")
    wait_until(lambda: len(host.alive()) == 2, "the shell has started its sleep")
    assert "SIGKILL" in host.ended(client, "one").message
    assert host.alive() == []


def test_a_killed_supervisor_puts_no_fence_off(host, client):
    """Repeated kills of the supervisor do not postpone the fence."""
    client.start([host.order("one", *SLEEPS, fence=Fence(2.0, 0.0))])
    pid = host.running(client, "one").pid
    deadline = time.monotonic() + PATIENCE
    while alive(pid):
        assert time.monotonic() < deadline, f"not fenced within {PATIENCE} s"
        client = host.replace_supervisor(client)
        client.receive(0.3)
    if not of_one(client).state.ended:
        host.ended(client, "one")


def test_a_supervisor_that_takes_over_knows_what_was_heard(host, client):
    """The next supervisor counts from the last renewal, not from the start of the instance."""
    heard = time.monotonic()
    client.start([host.order("one", *SLEEPS, fence=Fence(15.0, 0.0), last_contact=heard - 14.0)])
    pid = host.running(client, "one").pid
    client.send(ContactReported(time.monotonic(), 0.0))
    client.send(Remember(key_of(ONE), "after the word that counts"))
    client.start([host.order("other", "true")])
    host.ended(client, "other")  # by then the supervisor has read all orders
    wait_until(lambda: time.monotonic() > heard + 1.5, "its start lies back so far")
    client = host.replace_supervisor(client)
    assert client.fenced == {ONE}
    assert (of_one(client).state, of_one(client).pid) == (InstanceState.RUNNING, pid)
    assert client.receive(0.5) == []
    assert alive(pid)


def test_without_a_supervisor_nobody_fences_until_the_next(host, client):
    """An unsupervised instance outlives its fence; the next supervisor ends it at once."""
    client.start([host.order("one", *SLEEPS, fence=Fence(0.5, 0.0))])
    pid = host.running(client, "one").pid
    host.kill_supervisor(client)
    holds_for(1.0, lambda: alive(pid), "twice its fence")
    client = host.connect()
    if not of_one(client).state.ended:
        host.ended(client, "one")
    wait_gone(pid)


def test_after_a_restart_of_the_machine_it_is_not_started(host, client):
    """The length of the outage is unknown, so a successor may run elsewhere: no restart."""
    client.start([host.order("driver", *SLEEPS, restart=ALWAYS)])
    pids = [host.running(client, "driver").pid]
    client.start([host.order("one", *SLEEPS, restart=ALWAYS, fence=Fence(1000.0, 0.0))])
    pids.append(host.running(client, "one").pid)
    lose_power(host, client, *pids)
    client = host.connect()
    if not of_one(client).state.ended:
        host.ended(client, "one")
    client = host.reconnect(client)
    assert of_one(client).state is InstanceState.FENCED
    assert of_one(client).message.startswith("fenced: ")
    wait_until(host.alive, "the driver was started again")


def test_after_a_restart_of_the_machine_the_policy_decides(host, client):
    """A service restarts, even with its restarts used up; a process without a policy has failed."""
    again = RestartPolicy("on-failure", delay=0.05, attempts=1, window=1e6)
    client.start([host.order("once", *SLEEPS)])
    pid = host.running(client, "once").pid
    client.start([host.order("service", *SLEEPS, restart=again)])
    os.kill(host.running(client, "service").pid, signal.SIGKILL)
    lose_power(host, client, pid, host.running(client, "service").pid)
    client = host.connect()
    (once,) = [status for status in client.instances if status.instance.process == "once"]
    assert (once.state, once.message) == (InstanceState.FAILED, "its machine was restarted")
    assert once.known_exit is None
    assert host.running(client, "service").restarts == 2


def lose_power(host, client, *pids: int) -> None:
    """Kill supervisor and processes, and rewrite the record as after a reboot of the machine."""
    host.kill_supervisor(client)
    for pid in pids:
        os.kill(pid, signal.SIGKILL)
        wait_gone(pid)
    host.rewrite(lambda line: line["record"] == "header" and line.update(boot="another"))


def without_fences(line: dict) -> None:
    for name in ("fence", "fenced", "heard", "kill_by", "memo"):
        line.pop(name, None)


def test_a_record_of_an_earlier_version_is_taken_over(host, client):
    """Instances in a record without fences and memos keep running."""
    client.start([host.order("one", *SLEEPS)])
    pid = host.running(client, "one").pid
    host.kill_supervisor(client)
    host.rewrite(without_fences)
    client = host.connect()
    assert client.notes == ()
    assert client.fenced == frozenset()
    assert (of_one(client).state, of_one(client).pid) == (InstanceState.RUNNING, pid)


def test_a_supervisor_that_was_stopped_hears_first_what_was_said_in_time(host, client):
    """A resumed supervisor reads its client's renewals before it applies an expired fence."""
    client.start([host.order("one", *SLEEPS, fence=Fence(1.0, 0.0, alive=True))])
    pid = host.running(client, "one").pid

    def renews() -> bool:
        client.send(ContactReported(0.0, time.monotonic()))
        return True

    os.kill(client.pid, signal.SIGSTOP)
    try:
        holds_for(2.5, renews, "more than its fence")
    finally:
        renews()
        os.kill(client.pid, signal.SIGCONT)

    def goes_on() -> bool:
        return renews() and not any(status.state.ended for status in client.receive(0.05))

    holds_for(0.7, goes_on, "not fenced")
    assert alive(pid)
