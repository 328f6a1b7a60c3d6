"""The benchmark of the decision."""

from __future__ import annotations

from benchmarks.decide import Bench
from rosrm.core.master.settings import CoreSettings


def test_the_cluster_of_the_benchmark_has_every_host() -> None:
    """A master refuses hosts beyond `max_hosts`, and the benchmark needs more than the default."""
    hosts = CoreSettings().max_hosts + 1
    assert len(Bench(hosts).state.hosts) == hosts
