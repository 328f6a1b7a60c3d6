"""Restart of a killed slave, whose processes keep running."""

from __future__ import annotations

import signal

from rosrm.config.settings import LivenessSettings
from tests.ros.clusters import PATIENCE, alive, host, service


def test_a_master_that_is_slow_to_notice_costs_no_process(make_cluster) -> None:
    """The master believes the former slave alive for longer than the new one waits for the name."""
    cluster = make_cluster(host("h0"), liveness=LivenessSettings(suspect=8.0, lease=60.0))
    cluster.submit(service("p"))
    pid = cluster.wait("p", "running").pid
    slave = cluster.slaves["h0"].process
    slave.send_signal(signal.SIGKILL)
    slave.wait(PATIENCE)
    cluster.start_slave_again("h0")
    row = cluster.wait("p", "running")
    assert (row.pid, alive(pid)) == (pid, True)
