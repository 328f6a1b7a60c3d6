"""rosrm: a job for each process, on a master and three slaves, with keys and a journal."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from benchmarks import latency, throughput
from benchmarks.hosts import three_hosts
from benchmarks.peers import measuring, work
from benchmarks.stopping import own_keys
from rosrm.model.values import Kind, ProcessSpec
from rosrm.testing.local_cluster import LocalCluster

_WARM_UP = 20


def stamps(count: int) -> list[float]:
    """Return the milliseconds from each call to the stamp of its process, one at a time."""
    with (
        tempfile.TemporaryDirectory(prefix="rosrm-peers-") as folder,
        LocalCluster(Path(folder), hosts=three_hosts()) as cluster,
    ):
        found = [latency.submitted_ms(cluster, number) for number in range(_WARM_UP + count)]
        return found[_WARM_UP:]


def jobs(count: int) -> float:
    """Return the `true` jobs a second, submitted at once."""
    specs = [_job(f"true{number}", "true") for number in range(count)]
    return count / throughput.measure(three_hosts(), specs)


def sleeps(count: int) -> float:
    """Return the makespan of `sleep 0.1`, in times the ideal of three slots."""
    specs = [_job(f"sleep{number}", "sleep", "0.1") for number in range(count)]
    return throughput.measure(three_hosts(max_processes=1), specs) / (count / 3 * 0.1)


def holders(count: int) -> float:
    """Return the seconds until processes of 40 MB, submitted at once, have filled their memory."""
    with (
        tempfile.TemporaryDirectory(prefix="rosrm-peers-") as folder,
        LocalCluster(Path(folder), hosts=three_hosts()) as cluster,
    ):
        return measuring.holders(Holders(cluster), count)


class Holders:
    """Executor of `work.hold` alone: a job for each process."""

    def __init__(self, cluster: LocalCluster) -> None:
        self._cluster = cluster

    def start(self, function: Callable[[Any], Any], items: Sequence[Any]) -> Sequence[ProcessSpec]:
        assert function is work.hold
        specs = [_job(f"holder{number}", *work.holder(*item)) for number, item in enumerate(items)]
        self._cluster.client.submit(specs)
        return specs

    def results(self, handle: Sequence[ProcessSpec]) -> list[Any]:
        throughput.wait_for_all(self._cluster, handle)
        return []


def _job(name: str, *command: str) -> ProcessSpec:
    return ProcessSpec(name, command=command, kind=Kind.JOB)


if __name__ == "__main__":
    with own_keys():
        measuring.main({"stamps": stamps, "jobs": jobs, "sleeps": sleeps, "holders": holders})
