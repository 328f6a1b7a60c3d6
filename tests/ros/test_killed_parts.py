"""SIGKILL of master, slave and supervisor: their processes keep running."""

from __future__ import annotations

import os
import signal

import pytest

from rosrm.config.settings import LivenessSettings
from rosrm.model.values import RestartPolicy
from tests.ros.clusters import alive, host, job, pids_of, service
from tests.waiting import wait_gone, wait_until


@pytest.fixture(scope="module")
def cluster(make_shared):
    return make_shared(host("h0", max_processes=3), host("h1", max_processes=3))


def identity(row) -> tuple:
    return row.pid, row.number, row.host


def test_a_killed_master(cluster) -> None:
    """The next master keeps pids and the order of the queue; nothing is lost or started twice."""
    services = [f"s{n}" for n in range(6)]
    cluster.submit(*map(service, services))
    before = {name: cluster.wait(name, "running") for name in services}
    cluster.submit(*(job(f"q{n}", "true") for n in range(5)), job("first", "true", priority=3))
    epoch = cluster.events("master_started")[-1].message

    cluster.end(cluster.master, signal.SIGKILL)
    os.kill(before["s5"].pid, signal.SIGKILL)  # ends without a master
    cluster.reconnect()
    cluster.start_master()
    for name in services[:5]:
        assert identity(cluster.wait(name, "running")) == identity(before[name])
    assert cluster.ended("s5").state == "failed"
    queue = ["first", "q0", "q1", "q2", "q3", "q4"]
    for name in queue:
        assert cluster.ended(name).state == "finished"
    assert cluster.events("master_started")[-1].message != epoch
    assigned = [event.process for event in cluster.events("assigned")]
    assert [name for name in assigned if name in queue] == queue
    assert all(assigned.count(name) == 1 for name in services)
    cluster.cancel(*services[:5])


def test_a_killed_slave(make_cluster) -> None:
    """The next slave finds the same pids, reports exits since, with codes, and takes new work.

    The master believes the former slave alive for longer than the new one waits for the name.
    """
    cluster = make_cluster(host("h0"), liveness=LivenessSettings(suspect=8.0, lease=60.0))
    go = cluster.directory / "go"
    script = f"while [ ! -e {go} ]; do sleep 0.05; done; exit 5"
    cluster.submit(service("stays"), job("ends", "sh", "-c", script))
    before = cluster.wait("stays", "running")
    cluster.wait("ends", "running")

    cluster.end(cluster.slaves["h0"], signal.SIGKILL)
    assert alive(before.pid)
    go.touch()
    cluster.start_slave_again("h0")
    row = cluster.ended("ends")
    assert (row.state, row.exit_code) == ("failed", 5)
    assert identity(cluster.wait("stays", "running")) == identity(before)
    assert cluster.run(job("more", "true"))[0].state == "finished"
    cluster.cancel("stays")
    assert not alive(before.pid)


def test_a_killed_supervisor(cluster) -> None:
    """The slave starts another supervisor: same pids, exits are reported, new work runs."""
    cluster.submit(service("p"))
    before = cluster.wait("p", "running")
    first = cluster.supervisor(before.host)
    os.kill(first, signal.SIGKILL)
    wait_until(lambda: cluster.supervisor(before.host) != first, "another supervisor")

    more = [job(f"more{n}", "true") for n in range(4)]  # on each host
    assert {row.state for row in cluster.run(*more)} == {"finished"}
    assert identity(cluster.wait("p", "running")) == identity(before)
    os.kill(before.pid, signal.SIGKILL)
    assert cluster.ended("p").state == "failed"
    assert cluster.slaves[before.host].process.poll() is None


def test_a_killed_master_and_its_slaves(cluster) -> None:
    """Processes keep running while all parts are killed and restarted."""
    cluster.submit(service("p"))
    before = cluster.wait("p", "running")
    for part in cluster.parts():
        cluster.end(part, signal.SIGKILL)
    cluster.reconnect()
    for one in cluster.hosts:
        cluster.start_slave(one)
    cluster.start_master()
    assert identity(cluster.wait("p", "running")) == identity(before)
    cluster.wait_for_hosts()
    cluster.cancel("p")


def test_a_power_cut_of_a_host(cluster) -> None:
    """After a power cut of host, supervisor and process, the restart policy starts the service."""
    cluster.submit(service("p", restart=RestartPolicy("on-failure", delay=0.1)))
    before = cluster.wait("p", "running")
    slave = cluster.slaves[before.host]
    pids = {slave.process.pid, before.pid, *pids_of(cluster.directory / "hosts" / before.host)}
    for pid in pids:
        os.kill(pid, signal.SIGSTOP)  # none of them notices the end of another
    for pid in pids:
        os.kill(pid, signal.SIGKILL)
    wait_gone(before.pid)
    cluster.start_slave_again(before.host)
    after = cluster.wait("p", "running", where=lambda row: row.pid != before.pid)
    assert (after.host, after.number) == (before.host, before.number)
    cluster.cancel("p")
