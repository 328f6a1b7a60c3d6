"""Fences: an isolated host stops its singletons; processes without a fence keep running."""

from __future__ import annotations

import os
import signal
import time

from rosrm.config.settings import ControlSettings, LivenessSettings
from rosrm.model.values import HostLossPolicy, IsolationPolicy
from tests.faults.test_host_loss import held
from tests.ros.clusters import PATIENCE, alive, host, service, wait_gone, wait_until

SOON = {
    "liveness": LivenessSettings(suspect=1.0, lease=4.0),
    "control": ControlSettings(beat_period=0.1),
}


def both(cluster, after: float = 2.0):
    """Start a singleton that stops when its host is isolated, and a driver that does not."""
    stop = IsolationPolicy("stop", after)
    cluster.submit(service("singleton", isolation=stop), service("driver"))
    return cluster.wait("singleton", "running"), cluster.wait("driver", "running")


def test_the_supervisor_of_a_stopped_slave_fences(make_cluster) -> None:
    """The singleton runs again when the slave resumes; the driver never stops."""
    cluster = make_cluster(host("h0"), **SOON)
    singleton, driver = both(cluster)
    with held(cluster, "h0"):
        wait_gone(singleton.pid)
        assert alive(driver.pid)
    again = cluster.wait_until(
        "the singleton runs again",
        lambda v: any(
            (row.name, row.state, row.pid != singleton.pid) == ("singleton", "running", True)
            for row in v.processes
        ),
    )
    assert {row.name: row.restarts for row in again.processes}["singleton"] == 0
    assert cluster.wait("driver", "running").pid == driver.pid


def test_it_has_ended_when_its_successor_starts(make_cluster) -> None:
    """The old singleton ends before its successor starts, in a time derived from the lease."""
    liveness = LivenessSettings(suspect=2.0, lease=6.0)
    cluster = make_cluster(host("h0"), host("h1"), **{**SOON, "liveness": liveness})
    policies = {"isolation": IsolationPolicy("stop"), "host_loss": HostLossPolicy("elsewhere")}
    cluster.submit(service("singleton", **policies))
    before = cluster.wait("singleton", "running")
    with held(cluster, before.host):
        wait_gone(before.pid)
        assert not cluster.events("given_up")
        cluster.wait_for_event("given_up", process="singleton")
        assert cluster.wait("singleton", "running").host != before.host
    assert cluster.wait("singleton", "running").host != before.host


def test_without_a_master_nobody_hears_the_host(make_cluster) -> None:
    """An isolated slave stops its singletons; the next master has them started again."""
    cluster = make_cluster(host("h0"), **SOON)
    singleton, driver = both(cluster)
    cluster.master.process.kill()
    cluster.master.process.wait(PATIENCE)
    wait_gone(singleton.pid)
    assert alive(driver.pid)
    cluster.start_master()
    cluster.reconnect()
    assert cluster.wait("singleton", "running").pid != singleton.pid
    assert cluster.wait("driver", "running").pid == driver.pid


def test_a_singleton_that_is_heard_goes_on_whoever_is_killed(make_cluster) -> None:
    """The next supervisor and the next slave know the time of the host's last contact."""
    cluster = make_cluster(host("h0"), **SOON)
    after = 8.0  # seconds; a killed slave is back before
    singleton, driver = both(cluster, after)
    lock = cluster.directory / "hosts" / "h0" / "supervisor" / "supervisor.lock"
    first = int(lock.read_text())
    os.kill(first, signal.SIGKILL)
    wait_until(lambda: lock.read_text().strip() not in ("", str(first)), "another supervisor")
    slave = cluster.slaves["h0"].process
    slave.kill()
    slave.wait(PATIENCE)
    cluster.start_slave_again("h0")
    until = time.monotonic() + after + 1.0
    wait_until(lambda: time.monotonic() > until, "longer than its fence")
    rows = [cluster.wait(name, "running").pid for name in ("singleton", "driver")]
    assert rows == [singleton.pid, driver.pid]
    with held(cluster, "h0"):
        wait_gone(singleton.pid)
        assert alive(driver.pid)
