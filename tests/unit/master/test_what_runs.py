"""Last log line of the master: processes that keep running, apart from those being stopped."""

from __future__ import annotations

from rosrm.core.master import events as happened
from rosrm.master.runtime import what_runs
from tests.unit.core.cluster import Cluster, process

AGAIN = "start the master again to manage them"


def test_processes_of_hosts_that_leave_do_not_keep_running() -> None:
    """Their slaves stop them; the user starts the master again only for the others."""
    cluster = Cluster("a", "b", "c")
    assert what_runs(cluster.state) == "no processes keep running"
    cluster.submit(*(process(name) for name in "pqr"))
    assert cluster.counts() == {"a": 1, "b": 1, "c": 1}
    assert what_runs(cluster.state) == f"3 processes keep running; {AGAIN}"
    still = "still being stopped by the"
    said = [
        f"1 process is {still} slave of a; 2 processes keep running; {AGAIN}",
        f"2 processes are {still} slaves of a and b; 1 process keeps running; {AGAIN}",
        f"3 processes are {still} slaves of a, b and c",
    ]
    for machine, expected in zip(cluster.machines.values(), said, strict=True):
        cluster.ask(happened.HostLeft, machine.host_id, machine.incarnation, settle=False)
        assert what_runs(cluster.state) == expected
