"""Detached hosts: their slave was stopped and left processes running."""

from __future__ import annotations

from typing import Any

import pytest

from rosrm.core.master import events as happened
from rosrm.core.master import listing
from rosrm.model.values import HostLossPolicy, ProcessSpec
from tests.unit.core.cluster import Cluster, job, process

REASON = "a is detached: its slave was stopped and left processes running"


def detached(spec: ProcessSpec, **settings: Any) -> Cluster:
    """Return a cluster with a process on the detached host a; host b takes queued work."""
    cluster = Cluster("a", **settings).with_processes(spec)
    cluster.add("b")
    cluster.wait(11.0)  # the master has had contact with some host for a whole lease
    assert cluster.where(spec.name) == ["a"]
    cluster.detach("a")
    return cluster


def state_of(cluster: Cluster, host: str) -> str:
    rows = listing.host_rows(cluster.state, cluster.now)
    return next(row.state for row in rows if row.description.name == host)


def row_of(cluster: Cluster, name: str) -> Any:
    return listing.process_row(cluster.state, cluster[name], cluster.now)


def test_a_host_is_detached_however_long() -> None:
    """The host is neither suspect nor lost; its processes are unreachable at once."""
    cluster = detached(process("p"))
    assert cluster.recorded("host_detached") == [
        "a is detached: its slave was stopped and left 1 process running"
    ]
    for _ in range(3):
        assert state_of(cluster, "a") == "detached"
        row = row_of(cluster, "p")
        assert (row.state, row.reason, row.stale) == ("unreachable", REASON, True)
        cluster.wait(50.0)
    assert cluster.recorded("host_suspect") == cluster.recorded("host_lost") == []


def test_the_next_slave_readopts_the_processes() -> None:
    """The next slave adopts the same instance, even after the lease."""
    cluster = detached(process("p"))
    number = cluster["p"].owner
    cluster.wait(50.0)
    assert cluster.restart_slave("a").accepted
    assert (cluster.phase("p"), cluster["p"].owner) == ("running", number)
    assert state_of(cluster, "a") == "up"


def test_a_process_starts_elsewhere_as_late_as_after_a_loss() -> None:
    """The instance has a fence, which counts from the last beat: it needs the whole lease."""
    cluster = detached(process("p", host_loss=HostLossPolicy("elsewhere", 5.0)))
    lease = cluster.settings.lease
    cluster.wait(lease + 4.0)
    assert cluster.where("p") == ["a"]
    cluster.wait(2.0)
    assert cluster["p"].owner in {one.number for one in cluster.machines["b"].programs}
    assert cluster.recorded("given_up") == [f"p#1 is given up: {REASON}"]
    cluster.restart_slave("a")
    assert cluster.where("p") == ["b"]


def test_an_end_before_the_stop_of_the_slave_is_known() -> None:
    """The slave's last message has all its instances, including ends not reported before."""
    cluster = Cluster("a").with_processes(process("p"), job("q"))
    machine = cluster.machines["a"]
    machine.finish("q", cluster.now)
    machine.status_batches.clear()  # on its way, and overtaken by the last message
    cluster.detach("a")
    assert cluster.phase("q") == "finished"


def test_an_assignment_that_has_not_started_is_queued_again() -> None:
    """The slave starts no more processes, so the master queues the assignment again."""
    cluster = detached(process("p"))
    cluster.restart_slave("a")
    cluster.machines["b"].takes = False
    cluster.wait(1.0)
    cluster.ask(happened.SubmissionReceived, (process("q"),), settle=False)
    assert cluster["q"].phase.value == "assigned"
    cluster.detach("a")
    assert (cluster.phase("p"), cluster.phase("q")) == ("unreachable", "queued")


def test_a_late_report_changes_nothing() -> None:
    """A late report is older than the slave's last message."""
    cluster = Cluster("a").with_processes(process("p"))
    kept = cluster.machines["a"].begun()
    cluster.detach("a")
    cluster.report("a", *kept)
    assert cluster.phase("p") == "unreachable"


@pytest.mark.parametrize("first", ["cancelled", "detached"])
def test_a_cancelled_process_names_the_host_that_it_waits_for(first: str) -> None:
    """The reason names host and time at once. The next slave is ordered to stop the process."""
    if first == "detached":
        cluster = detached(process("p"))
        cluster.wait(7.0)
        reply = cluster.cancel("p")
        assert reply.message == (
            "1 process being cancelled; p is being cancelled: waits for a, whose slave was stopped"
        )
    else:
        cluster = Cluster("a")
        cluster.submit(process("p"))
        cluster.machines["a"].stubborn.add("p")
        cluster.cancel("p")
        cluster.detach("a")
        cluster.wait(7.0)
    row = row_of(cluster, "p")
    reason = "being cancelled: waits for a, whose slave was stopped 7 s ago"
    assert (row.state, row.reason) == ("stopping", reason)
    cluster.machines["a"].stubborn.clear()
    cluster.restart_slave("a")
    assert (cluster.phase("p"), cluster.where("p")) == ("cancelled", [])


def test_a_cancelled_process_on_a_silent_host_names_the_host() -> None:
    """The reason names the host also while the host is suspect."""
    cluster = Cluster("a").with_processes(process("p"))
    cluster.cut("a", seconds=4.0)
    cluster.cancel("p")
    reason = "being cancelled: waits for a, which has been silent for 4 s"
    assert row_of(cluster, "p").reason == reason


def test_the_end_of_a_cancelled_process_is_known_when_its_slave_leaves() -> None:
    """As with `rosrm slave --stop-all`, the master learns the end of a cancelled process."""
    cluster = detached(process("p"))
    cluster.cancel("p")
    cluster.restart_slave("a")
    cluster.leave("a")
    assert (cluster.phase("p"), state_of(cluster, "a")) == ("cancelled", "left")


def test_a_detached_host_is_pruned_once_nothing_is_left_there() -> None:
    """Pruning a host by name also gives up what is being cancelled there."""
    cluster = detached(process("p"))
    cluster.ask(happened.PruneRequested)
    assert state_of(cluster, "a") == "detached"
    cluster.cancel("p")
    assert cluster.ask(happened.PruneRequested, (), ("a",)).accepted
    assert cluster.phase("p") == "cancelled"


def test_a_registration_counts_the_processes_that_have_not_ended() -> None:
    """A restarted slave also reports the processes that ended while no slave ran."""
    cluster = Cluster("a").with_processes(process("p"), job("q"))
    cluster.detach("a")
    cluster.machines["a"].finish("q", cluster.now)
    cluster.restart_slave("a")
    assert cluster.recorded("host_registered")[-1] == "a registered with 1 process"
