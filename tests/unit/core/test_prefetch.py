"""Assignment ahead of a free slot: conditions and withdrawal."""

from __future__ import annotations

from rosrm.core.master import events as happened
from rosrm.core.master.assignment.prefetch import PROVED_LONG
from rosrm.model.values import InstanceId, InstanceState, InstanceStatus
from tests.unit.core.cluster import Cluster, Machine, job


def cluster_of_one_slot(run_time: float) -> Cluster:
    """Return a cluster of one host with one slot, on which a job has run once."""
    cluster = Cluster(Machine("a", max_processes=1)).with_processes(job("first"))
    cluster.finish("first", run_time=run_time)
    return cluster


def test_one_short_job_is_prefetched_behind_another() -> None:
    """The slave holds the next job and starts it as soon as the slot is free."""
    cluster = cluster_of_one_slot(run_time=0.1)
    cluster.submit(job("p"), job("q"), job("r"))
    assert [cluster.phase(name) for name in "pqr"] == ["running", "assigned", "queued"]
    cluster.machines["a"].finish("p", cluster.now, run_time=0.1)
    assert "q" in {i.process for i in cluster.machines["a"].programs}
    cluster.settle()
    assert [cluster.phase(name) for name in "pqr"] == ["finished", "running", "assigned"]


def test_no_job_is_prefetched_behind_a_long_one() -> None:
    """An assignment ahead needs a known run time from earlier runs of the same program."""
    cluster = cluster_of_one_slot(run_time=60.0)
    cluster.submit(job("p"), job("q"))
    assert [cluster.phase(name) for name in "pq"] == ["running", "queued"]


def test_a_prefetched_job_behind_a_long_one_returns_to_its_place() -> None:
    """The job is withdrawn unstarted, and goes to the next host with a free slot."""
    cluster = cluster_of_one_slot(run_time=0.1)
    cluster.submit(job("p"), job("q"), job("r"))
    assert cluster.phase("q") == "assigned"
    cluster.wait(PROVED_LONG + 1.0)
    assert [cluster.phase(name) for name in "pqr"] == ["running", "queued", "queued"]
    assert cluster.queue() == ["q", "r"]
    cluster.add(Machine("b", max_processes=1))
    assert cluster.where("q") == ["b"]


def test_a_prefetched_job_can_be_cancelled() -> None:
    """A cancelled job that waits ahead never starts."""
    cluster = cluster_of_one_slot(run_time=0.1)
    cluster.submit(job("p"), job("q"))
    cluster.cancel("q")
    assert [cluster.phase(name) for name in "pq"] == ["running", "cancelled"]


def test_a_held_job_that_is_restarted_runs_once() -> None:
    """The job has not started yet, so a restart changes nothing."""
    cluster = cluster_of_one_slot(run_time=0.1)
    cluster.submit(job("p"), job("q"))
    cluster.wait(1.0)
    assert cluster.restart("q").accepted
    cluster.finish("p", run_time=0.1)
    cluster.finish("q", run_time=0.1)
    assert cluster.phase("q") == "finished"


def test_a_held_job_stays_on_a_detached_host() -> None:
    """The supervisor of the host starts it in its turn, and no order to stop it would arrive."""
    cluster = cluster_of_one_slot(run_time=0.1)
    cluster.submit(job("p"), job("q"))
    machine, held = cluster.machines["a"], InstanceId("q", cluster["q"].owner)
    left = (*machine.begun(), InstanceStatus(held, InstanceState.HELD))
    cluster.ask(happened.HostLeft, machine.host_id, machine.incarnation, left)
    machine.connected = False
    cluster.wait(PROVED_LONG + 1.0)
    assert not cluster.state.instances[held.number].stopping
