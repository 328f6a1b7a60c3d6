"""Fences: an isolated host stops its singletons; processes without a fence keep running."""

from __future__ import annotations

import os
import signal

import pytest

from rosrm.config.settings import ControlSettings, LivenessSettings
from rosrm.model.values import HostLossPolicy, IsolationPolicy
from tests.faults.test_host_loss import held
from tests.ros.clusters import alive, host, service
from tests.waiting import wait_gone, wait_until

SOON = {
    "liveness": LivenessSettings(suspect=1.0, lease=4.0),
    "control": ControlSettings(beat_period=0.1),
}


@pytest.fixture(scope="module")
def cluster(make_shared):
    return make_shared(host("h0"), **SOON)


@pytest.fixture
def both(cluster):
    """Yield a function that starts a singleton, which stops when its host is isolated.

    It starts a driver, too, which does not stop, and returns both rows.
    """

    def start(after: float = 2.0):
        stop = IsolationPolicy("stop", after)
        cluster.submit(service("singleton", isolation=stop), service("driver"))
        return cluster.wait("singleton", "running"), cluster.wait("driver", "running")

    yield start
    cluster.cancel("singleton", "driver")


def test_the_supervisor_of_a_stopped_slave_fences(cluster, both) -> None:
    """The singleton runs again when the slave resumes; the driver never stops."""
    singleton, driver = both()
    with held(cluster, "h0"):
        wait_gone(singleton.pid)
        assert alive(driver.pid)
    again = cluster.wait("singleton", "running", where=lambda row: row.pid != singleton.pid)
    assert again.restarts == 0
    assert cluster.wait("driver", "running").pid == driver.pid


def test_a_singleton_has_ended_when_its_successor_starts(make_cluster) -> None:
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


def test_a_slave_without_a_master_fences(cluster, both) -> None:
    """An isolated slave stops its singletons; the next master has them started again."""
    singleton, driver = both()
    cluster.end(cluster.master, signal.SIGKILL)
    wait_gone(singleton.pid)
    assert alive(driver.pid)
    cluster.start_master()
    cluster.reconnect()
    cluster.wait("singleton", "running", where=lambda row: row.pid != singleton.pid)
    assert cluster.wait("driver", "running").pid == driver.pid


def test_kills_of_supervisor_and_slave_fence_nothing(cluster, both) -> None:
    """The next supervisor and the next slave know the time of the host's last contact."""
    after = 8.0  # seconds; a killed slave is back before
    singleton, driver = both(after)
    first = cluster.supervisor("h0")
    os.kill(first, signal.SIGKILL)
    wait_until(lambda: cluster.supervisor("h0") != first, "another supervisor")
    cluster.start_slave_again("h0")
    cluster.stays(
        after + 1.0, lambda: alive(singleton.pid) and alive(driver.pid), "longer than its fence"
    )
    rows = [cluster.wait(name, "running").pid for name in ("singleton", "driver")]
    assert rows == [singleton.pid, driver.pid]
    with held(cluster, "h0"):
        wait_gone(singleton.pid)
        assert alive(driver.pid)
