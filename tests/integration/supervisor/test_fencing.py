"""Fences of real processes while slave and supervisor are paused or killed."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest

import rosrm
from rosrm import clocks
from rosrm.core.supervisor.events import ContactReported, RestartOrdered, StopOrdered
from rosrm.model.values import Fence, InstanceId, InstanceState, RestartPolicy, StopPolicy
from rosrm.supervisor.client_values import key_of
from rosrm.supervisor.messages import Remember
from rosrm.supervisor.procfs import KEEP
from tests.waiting import PATIENCE, holds_for, wait_gone, wait_until

from .conftest import kill

DEAF = ("sh", "-c", "trap '' INT TERM; echo deaf; (trap '' INT TERM; sleep 1000) & wait; wait")
ONE = InstanceId("one", 1)
ALWAYS = RestartPolicy("always", delay=0.05)

#: A slave that renews the lease continually, with a fenced singleton and an unfenced driver.
SLAVE = """
    import os, sys
    from pathlib import Path
    from rosrm import clocks
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
        client.send(ContactReported(clocks.boot_time(), 0.0))
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
    stopped = clocks.boot_time()
    wait_gone(one)
    took = clocks.boot_time() - stopped
    assert 1.5 < took < PATIENCE / 2, took  # the last renewal was 0.1 s before, on a quiet machine
    assert alive(driver)
    slave.kill()
    slave.wait()
    client = host.connect(start=False)
    assert of_one(client).state is InstanceState.FENCED
    assert of_one(client).message.startswith("fenced: no confirmed contact with the master for 3 s")


def test_an_alive_fence_is_renewed_by_the_running_slave_alone(host, client):
    """A fence with `alive` is renewed by the slave's sign of life alone, and ends without it."""
    fences = {"one": Fence(4.0, 0.0, alive=True), "two": Fence(4.0, 0.0)}
    client.start([host.order(name, "sleep", "1000", fence=fence) for name, fence in fences.items()])
    host.running(client, "one")
    until, ended = clocks.boot_time() + PATIENCE, set()
    while not ended:
        alive = clocks.boot_time()
        assert alive < until, "no instance was fenced"
        client.send(ContactReported(0.0, alive))
        received = client.receive(0.1)
        ended = {status.instance.process for status in received if status.state.ended}
    assert ended == {"two"}
    status = host.ended(client, "one")
    assert clocks.boot_time() - alive >= 4.0
    assert "no activity of its slave" in status.message


def test_a_fenced_tree_ends_within_its_grace(host, client):
    """An instance deaf to SIGINT and SIGTERM ends by SIGKILL, with its child, within the fence."""
    graces = StopPolicy(interrupt_grace=500.0, terminate_grace=500.0)
    client.start([host.order("one", *DEAF, fence=Fence(2.0, 0.5), stop=graces)])
    host.running(client, "one")
    wait_until(lambda: len(host.alive()) == 2, "the shell has started its sleep")
    assert "SIGKILL" in host.ended(client, "one").message
    assert host.alive() == []


def test_a_killed_supervisor_puts_no_fence_off(host, client):
    """Repeated kills of the supervisor do not postpone the fence."""
    pid = host.sleeper(client, "one", fence=Fence(2.0, 0.0))
    deadline, told = clocks.boot_time() + PATIENCE, []
    while alive(pid):
        assert clocks.boot_time() < deadline, f"not fenced within {PATIENCE} s"
        client = host.replace_supervisor(client)
        told = [*client.instances, *client.receive(0.3)]
    if not any(status.state.ended for status in told):
        host.ended(client, "one")


def test_the_next_supervisor_knows_the_last_contact(host, client):
    """The next supervisor counts from the last renewal, not from the start of the instance."""
    heard = clocks.boot_time()
    pid = host.sleeper(client, "one", fence=Fence(15.0, 0.0), last_contact=heard - 14.0)
    client.send(ContactReported(clocks.boot_time(), 0.0))
    client.send(Remember(key_of(ONE), "after the word that counts"))
    client.start([host.order("other", "true")])
    host.ended(client, "other")  # by then the supervisor has read all orders
    wait_until(lambda: clocks.boot_time() > heard + 1.5, "its start lies back so far")
    client = host.replace_supervisor(client)
    assert client.fenced == {ONE}
    assert (of_one(client).state, of_one(client).pid) == (InstanceState.RUNNING, pid)
    assert client.receive(0.5) == []
    assert alive(pid)


def test_the_next_supervisor_ends_an_expired_instance(host, client):
    """An unsupervised instance outlives its fence; the next supervisor ends it at once."""
    pid = host.sleeper(client, "one", fence=Fence(0.5, 0.0))
    host.kill_supervisor(client)
    holds_for(1.0, lambda: alive(pid), "twice its fence")
    client = host.connect()
    host.ended_after_connect(client, "one")
    wait_gone(pid)


def test_after_a_restart_of_the_machine_it_is_not_started(host, client):
    """The process is not restarted: the outage may have been long, and a successor may run.

    That holds also for a fence that is longer than the machine runs.
    """
    fence = Fence(clocks.boot_time() + 1000.0, 0.0)
    pids = [host.sleeper(client, "driver", restart=ALWAYS)]
    pids.append(host.sleeper(client, "one", restart=ALWAYS, fence=fence))
    lose_power(host, client, *pids)
    client = host.connect()
    host.ended_after_connect(client, "one")
    client = host.reconnect(client)
    assert of_one(client).state is InstanceState.FENCED
    assert of_one(client).message.startswith("fenced: ")
    wait_until(host.alive, "the driver was started again")


def test_after_a_restart_of_the_machine_the_policy_decides(host, client):
    """A service restarts, even with its restarts used up; a process without a policy has failed."""
    again = RestartPolicy("on-failure", delay=0.05, attempts=1, window=1e6)
    pid = host.sleeper(client, "once")
    client.start([host.order("service", "sleep", "1000", restart=again)])
    os.kill(host.running(client, "service").pid, signal.SIGKILL)
    lose_power(host, client, pid, host.running(client, "service").pid)
    client = host.connect()
    (once,) = [status for status in client.instances if status.instance.process == "once"]
    assert (once.state, once.message) == (InstanceState.FAILED, "its machine was restarted")
    assert once.known_exit is None
    assert host.running(client, "service").restarts == 2


UNKNOWN = "its machine was restarted: whether it had run is not known"


@pytest.mark.parametrize("tried", [False, True], ids=["before its spawn", "at its spawn"])
def test_after_a_restart_of_the_machine_a_job_that_was_starting_runs_no_second_time(
    host, client, tried
):
    """The disk may lack the lines of half a minute, in which the job ran and finished."""
    host.run(client, host.order("job", "touch", "ran"))
    host.kill_supervisor(client)
    host.cut_record(after_spawn=tried)
    host.rewrite(of_another_boot)
    (host.state / "work" / "ran").unlink()
    client = host.connect()
    (job,) = client.instances
    assert (job.state, job.message, job.known_exit) == (InstanceState.FAILED, UNKNOWN, None)
    assert client.receive(0.5) == []
    assert not (host.state / "work" / "ran").exists()


def test_after_a_restart_of_the_machine_what_was_held_may_have_run(host, client):
    """A job runs no second time, a service is started again, and a fence is for the master."""
    pid = host.sleeper(client, "first")
    orders = {"job": {}, "service": {"restart": ALWAYS}, "one": {"fence": Fence(1000.0, 0.0)}}
    for name, options in orders.items():
        client.start([host.order(name, "sleep", "1000", slots=1, **options)])
        host.wait(client, name, InstanceState.HELD)
    lose_power(host, client, pid)
    client = host.connect()
    found = {status.instance.process: status for status in client.instances}
    assert (found["job"].state, found["job"].message) == (InstanceState.FAILED, UNKNOWN)
    assert found["job"].known_exit is None
    assert found["one"].state is InstanceState.FENCED
    if found["service"].state is not InstanceState.RUNNING:
        host.running(client, "service")
    assert len(host.alive()) == 1


def test_after_a_restart_of_the_machine_no_job_is_restarted_by_a_former_order(host, client):
    """The run that the order began may have finished."""
    client.start([host.order("job", *DEAF, stop=StopPolicy(1000.0, 1000.0))])
    pid = host.running(client, "job").pid
    wait_until(host.log("job").read_text, "its handlers")
    client.send(RestartOrdered(("job", 1)))
    host.wait(client, "job", InstanceState.STOPPING)
    left = host.alive()
    host.kill_supervisor(client)
    kill(*left)
    assert pid in left
    host.rewrite(of_another_boot)
    client = host.connect()
    job = host.ended_after_connect(client, "job")
    assert (job.state, job.message) == (InstanceState.FAILED, "its machine was restarted")


def test_after_a_restart_of_the_machine_a_node_with_snapshots_is_left_to_the_master(host, client):
    """Its own snapshots may be half a minute old, and a replica on another host is newer."""
    keeps = {**os.environ, KEEP: "/snapshots/of/it"}
    slow = RestartPolicy("on-failure", delay=1000.0, max_delay=1000.0)
    client.start([host.order("first", "sleep", "1000", environment=keeps, restart=ALWAYS)])
    pids = [host.running(client, "first").pid, host.sleeper(client, "plain", restart=ALWAYS)]
    client.start([host.order("waits", "false", environment=keeps, restart=slow)])
    host.wait(client, "waits", InstanceState.BACKOFF)
    pids.append(host.sleeper(client, "job", environment=keeps))
    client.start([host.order("next", "true", environment=keeps, restart=ALWAYS, slots=1)])
    host.wait(client, "next", InstanceState.HELD)
    lose_power(host, client, *pids)
    client = host.connect()
    found = {status.instance.process: status for status in client.instances}
    for name in ("first", "waits", "next"):
        assert found[name].state is InstanceState.WITHDRAWN, found[name]
    assert "its machine was restarted" in found["first"].message
    assert found["job"].state is InstanceState.FAILED
    wait_until(lambda: len(host.alive()) == 1, "the one without snapshots")


def test_after_a_restart_of_the_machine_what_a_user_had_stopped_is_not_for_the_master(host, client):
    """The master would queue it again."""
    keeps = {**os.environ, KEEP: "/snapshots/of/it"}
    client.start([host.order("one", *DEAF, environment=keeps, restart=ALWAYS,
                             stop=StopPolicy(1000.0, 1000.0))])  # fmt: skip
    host.running(client, "one")
    wait_until(host.log("one").read_text, "its handlers")
    client.send(StopOrdered(("one", 1)))
    host.wait(client, "one", InstanceState.STOPPING)
    lose_power(host, client, *host.alive())
    client = host.connect()
    assert host.ended_after_connect(client, "one").state is InstanceState.EXITED


def of_another_boot(line: dict) -> None:
    if line["record"] == "header":
        line["boot"] = "another"


def lose_power(host, client, *pids: int) -> None:
    """Kill supervisor and processes, and rewrite the record as after a reboot of the machine."""
    host.kill_supervisor(client)
    kill(*pids)
    host.rewrite(of_another_boot)


def without_fences(line: dict) -> None:
    for name in ("fence", "fenced", "heard", "kill_by", "memo"):
        line.pop(name, None)


def test_a_record_of_an_earlier_version_is_taken_over(host, client):
    """Instances in a record without fences and memos keep running."""
    pid = host.sleeper(client, "one")
    host.kill_supervisor(client)
    host.rewrite(without_fences)
    client = host.connect()
    assert client.notes == ()
    assert client.fenced == frozenset()
    assert (of_one(client).state, of_one(client).pid) == (InstanceState.RUNNING, pid)


def test_a_resumed_supervisor_reads_renewals_before_it_fences(host, client):
    """A resumed supervisor reads its client's renewals before it applies an expired fence."""
    pid = host.sleeper(client, "one", fence=Fence(1.0, 0.0, alive=True))

    def renews() -> bool:
        client.send(ContactReported(0.0, clocks.boot_time()))
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
