"""A stall of the whole master that is longer than the default lease of DDS, 20 s."""

from __future__ import annotations

import signal
import time

import pytest

from tests.ros.clusters import host

#: Seconds of the stall.
STALL = 23.0
HOSTS = ("h0", "h1", "h2")


@pytest.mark.slow
def test_a_master_receives_its_hosts_and_clients_again_after_a_long_stall(make_cluster):
    """With the default lease, Fast DDS ignored some or all of them from then on."""
    cluster = make_cluster(*map(host, HOSTS))
    cluster.wait_for_hosts()
    master = cluster.master.process
    master.send_signal(signal.SIGSTOP)
    time.sleep(STALL)  # the fault itself
    master.send_signal(signal.SIGCONT)

    def all_are_up(view) -> bool:
        return [row.state for row in view.hosts] == ["up"] * len(HOSTS)

    cluster.wait_until("all hosts report to the master", all_are_up)
