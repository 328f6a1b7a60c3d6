"""Forgotten processes are freed at once, without a collection of garbage, which is rare."""

from tests.garbage import cyclic_garbage
from tests.unit.core.cluster import Cluster, job


def test_an_ended_job_that_is_forgotten_leaves_no_cycle_of_references():
    """Its decision, with the views for plugins, is freed by the count of its references."""
    cluster = Cluster("a", "b", keep_ended=3)
    _run_jobs(cluster, 10)
    with cyclic_garbage() as left:
        _run_jobs(cluster, 30, first=10)
        assert len(cluster.state.processes) < 30
    assert set(left) == set()


def _run_jobs(cluster: Cluster, count: int, first: int = 0) -> None:
    for number in range(first, first + count):
        cluster.submit(job(f"job{number}"))
        cluster.explain(f"job{number}")
        cluster.finish(f"job{number}", on=cluster.where(f"job{number}")[0])
        cluster.wait(0.2)
        cluster.records.clear()  # they have the decisions
        cluster.carried.clear()
