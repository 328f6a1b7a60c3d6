"""Hosts lost with all their processes or merely out of contact; processes with a standby."""

from __future__ import annotations

import contextlib
import os
import signal
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from rosrm.config.settings import ControlSettings, LivenessSettings
from rosrm.model.values import (
    HostLossPolicy,
    MigrationPolicy,
    ProcessSpec,
    RestartPolicy,
    StandbyPolicy,
)
from tests.faults.handoff_watcher import Watcher, instances
from tests.ros.clusters import QUICK, Cluster, alive, host, service
from tests.waiting import wait_until

ROOT = Path(__file__).resolve().parents[2]
SOON = {
    "liveness": LivenessSettings(suspect=0.6, lease=2.0),
    "control": ControlSettings(beat_period=0.1),
}
ELSEWHERE = HostLossPolicy("elsewhere")


def counter(name: str, **options) -> ProcessSpec:
    """Return a stateful process that counts by its timer and publishes the count."""
    return ProcessSpec(
        name, module="benchmarks.handoff_nodes", arguments=("count", "--rate", "50"),
        environment={"PYTHONPATH": str(ROOT)}, ros=True, stop=QUICK,
        migration=MigrationPolicy("handoff"), **options,
    )  # fmt: skip


@contextlib.contextmanager
def held(cluster: Cluster, name: str) -> Iterator[None]:
    """Pause the slave of a host; its processes keep running."""
    slave = cluster.slaves[name].process
    slave.send_signal(signal.SIGSTOP)
    try:
        yield
    finally:
        slave.send_signal(signal.SIGCONT)


@pytest.fixture(scope="module")
def cluster(make_shared):
    return make_shared(host("h0"), host("h1"), **SOON)


def test_a_process_goes_elsewhere_when_its_slave_hangs(cluster) -> None:
    """The supervisor ends the old instance before the successor starts: never two at once."""
    deaf = """
import signal, time
for number in (signal.SIGINT, signal.SIGTERM):
    signal.signal(number, signal.SIG_IGN)
time.sleep(999)
"""
    cluster.submit(service("p", sys.executable, "-c", deaf, host_loss=ELSEWHERE))
    before = cluster.wait("p", "running")
    with held(cluster, before.host):
        given_up = cluster.wait_for_event("given_up", process="p")
        assert not alive(before.pid)
        cluster.wait_for_event("assigned", process="p", after=given_up.sequence)
        after = cluster.wait("p", "running")
        assert after.host != before.host
    cluster.wait_for_event("host_back", host=before.host)
    assert set(instances(cluster, "p")) == {after.number}
    cluster.cancel("p")
    cluster.wait_for_hosts()


def test_a_process_that_waits_for_its_host_is_kept_by_it(cluster) -> None:
    """A process that waits for its host has no successor: the host still runs the same instance."""
    cluster.submit(service("waits"))
    before = cluster.wait("waits", "running")
    with held(cluster, before.host):
        assert cluster.wait("waits", "unreachable").host == before.host
    after = cluster.wait("waits", "running")
    assert (after.pid, after.number, after.host) == (before.pid, before.number, before.host)


def test_a_lost_host_comes_back_with_nothing(make_cluster) -> None:
    """After a power cut, waiting processes restart on their host; the others run elsewhere."""
    cluster = make_cluster(host("h0"), **SOON)
    again = RestartPolicy("on-failure", delay=0.1)
    cluster.submit(service("waits", restart=again), service("goes", host_loss=ELSEWHERE))
    first = cluster.wait("waits", "running")
    cluster.wait("goes", "running")
    cluster.add(host("h1"))
    cluster.switch_off("h0")
    assert cluster.wait("waits", "unreachable").host == "h0"
    cluster.wait("goes", "running", host="h1")
    cluster.start_slave(cluster.hosts[0])
    cluster.wait("waits", "running", where=lambda row: row.pid != first.pid)
    assert cluster.wait("goes", "running").host == "h1"


@pytest.mark.parametrize("how", ["process", "host"])
def test_a_standby_goes_on_from_the_last_state(make_cluster, how: str) -> None:
    """The standby continues the count when the primary or its host dies; a new standby follows."""
    hosts = ("h0", "h1", "h2")
    cluster = make_cluster(*map(host, hosts), **SOON)
    watcher = Watcher(cluster.domain, hosts)
    try:
        cluster.submit(counter("moving", standby=StandbyPolicy(wanted=True)))
        primary = cluster.wait("moving", "running")
        cluster.wait_for_event("standby_ready", process="moving")
        wait_until(lambda: len(watcher.outputs) > 50, "counts of the primary")
        if how == "process":
            os.kill(primary.pid, signal.SIGKILL)
        else:
            cluster.switch_off(primary.host)
        cluster.wait_for_event("failed_over", process="moving")
        row = cluster.wait("moving", "running")
        assert (row.number != primary.number, row.host != primary.host) == (True, True)
        wait_until(
            lambda: watcher.outputs[-1].instance == row.number and watcher.outputs[-1].sequence,
            "the standby is heard",
        )
        said = [one.sequence for one in watcher.outputs if one.instance == primary.number]
        goes_on = [one.sequence for one in watcher.outputs if one.instance == row.number]
        # The node publishes its state after its output: a kill in between loses that state.
        assert goes_on[0] - said[-1] in (0, 1), (said[-3:], goes_on[:3])
        ready = [event.message for event in cluster.events("standby_ready", process="moving")]
        cluster.wait_for_event("standby_begun", after=cluster.events("failed_over")[0].sequence)
        assert ready[0].startswith("the standby of moving is ready on")
    finally:
        watcher.close()
