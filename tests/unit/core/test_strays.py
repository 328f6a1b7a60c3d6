"""Instances that a host reports and the master never assigned to it."""

from __future__ import annotations

import pytest

from rosrm.core.master import events as happened
from rosrm.core.master.lifecycle import _MOST_STRAYS
from rosrm.core.slave import events as slave
from rosrm.model.requester import OPERATOR
from rosrm.model.values import (
    Assignment,
    HostLossPolicy,
    InstanceId,
    InstanceState,
    InstanceStatus,
    NeighbourRule,
)
from tests.unit.core.cluster import Cluster, Machine, job, process


def ghost(name: str, number: int, state: InstanceState = InstanceState.RUNNING) -> InstanceStatus:
    return InstanceStatus(InstanceId(name, number), state, pid=7, run_time=10.0)


def report(cluster: Cluster, host: str, *statuses: InstanceStatus) -> None:
    """Send a status batch of a host, as its key allows, in addition to those of its slave."""
    machine = cluster.machines[host]
    machine.batches += 1
    cluster.tell(
        happened.StatusesReceived(
            machine.host_id, machine.incarnation, machine.batches, False, statuses
        )
    )


def haunt(cluster: Cluster, host: str, name: str, number: int) -> None:
    """Let a host report an instance that it never ends."""
    machine = cluster.machines[host]
    machine.stubborn.add(name)
    instance = InstanceId(name, number)
    machine.tell(
        slave.AssignmentsReceived((Assignment(instance, process(name), 1, name),)), cluster.now
    )
    cluster.settle()


def test_a_ghost_gives_its_host_no_right_on_the_process() -> None:
    """A host that only reports an instance of a process gets no ticket for its snapshots."""
    from rosrm.master.queries import MasterQueries

    cluster = Cluster("a", "b").with_processes(process("p"))
    (own,) = cluster.where("p")
    (other,) = {"a", "b"} - {own}
    report(cluster, other, ghost("p", 500))
    queries = MasterQueries.__new__(MasterQueries)
    queries._state = cluster.state
    assert queries.has_held("p", own)
    assert not queries.has_held("p", other)
    report(cluster, other, ghost("p", 500, InstanceState.EXITED))
    assert not queries.has_held("p", other)


def test_a_ghost_refuses_no_submission_of_its_name() -> None:
    """The process is queued, waits for the end of the stray for a bounded time, and starts."""
    cluster = Cluster("a", "b")
    cluster.set_host("a", "cordon")
    haunt(cluster, "a", "p", 500)
    assert cluster.submit(process("p")).accepted
    cluster.wait(1.0)
    assert cluster["p"].reason == "waits until p#500 on a has ended"
    cluster.wait(cluster["p"].spec.stop.timeout + 31.0, tick=1.0)
    assert "b" in cluster.where("p")


def test_further_ghosts_do_not_prolong_the_wait() -> None:
    """The first report begins the wait for all."""
    cluster = Cluster("a", "b")
    cluster.set_host("a", "cordon")
    cluster.set_host("b", "cordon")
    assert cluster.submit(process("p")).accepted
    for number in range(50):
        haunt(cluster, "a", "p", 500 + number)
        cluster.wait(1.0, tick=0.5)
    cluster.set_host("b", "uncordon")
    haunt(cluster, "a", "p", 600)
    cluster.wait(1.0)
    assert "b" in cluster.where("p")


def test_a_ghost_ends_no_run_and_teaches_nothing() -> None:
    """The end of a stray changes neither phase, exit code nor learned needs of the process."""
    cluster = Cluster("a", "b").with_processes(job("p"))
    before = dict(cluster.intents["learned"])
    cluster.wait(1.0)
    report(cluster, "b", ghost("p", 500))
    report(cluster, "b", ghost("p", 500, InstanceState.FAILED))
    cluster.wait(1.0)
    assert cluster.phase("p") == "running"
    assert cluster.intents["learned"] == before


def test_a_ghost_moves_no_neighbour() -> None:
    """A host that reports a stray of one process may run another that must be apart from it."""
    cluster = Cluster("a")
    report(cluster, "a", ghost("p", 500))
    rule = NeighbourRule("apart", ("p",))
    assert cluster.submit(process("q", neighbours=(rule,))).accepted
    assert cluster.where("q") == ["a"]


def test_a_host_fills_the_master_with_a_bounded_number_of_ghosts() -> None:
    """The master orders the stop of all strays, and tracks only the first ones."""
    cluster = Cluster("a", "b").with_processes(process("p"))
    for batch in range(12):
        report(cluster, "a", *(ghost(f"g{batch}", 10_000 + n + 1000 * batch) for n in range(1000)))
    strays = sum(map(len, cluster.state.strays.values()))
    assert strays <= _MOST_STRAYS
    assert len(cluster.state.instances) <= _MOST_STRAYS + 1


@pytest.mark.parametrize("removed", [False, True])
def test_a_process_that_is_removed_leaves_no_stray_behind(*, removed: bool) -> None:
    """The master removes a stray that has ended, whether or not its process still exists."""
    cluster = Cluster("a").with_processes(job("p", host_loss=HostLossPolicy()))
    report(cluster, "a", ghost("p", 500))
    cluster.cancel("p")
    cluster.wait(1.0)
    if removed:
        assert cluster.ask(happened.PruneRequested, ("p",), (), OPERATOR).accepted
    report(cluster, "a", ghost("p", 500, InstanceState.EXITED))
    assert not cluster.state.strays


def test_a_pruned_host_gives_up_its_ghosts() -> None:
    """The strays of a lost host are removed together with the host."""
    cluster = Cluster("a", Machine("b"), lease=2.0)
    report(cluster, "b", ghost("p", 500))
    cluster.cut("b", seconds=10.0)
    assert cluster.ask(happened.PruneRequested, (), ("b",), OPERATOR).accepted
    assert not cluster.state.strays
