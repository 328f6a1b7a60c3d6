"""Rate of many short jobs submitted at once, and how well the slots of the hosts are used.

Two measurements on three hosts: 300 times `true` submitted at once (jobs a second, from the call of
`submit` to the last recorded end), and 150 times `sleep 0.1` with one slot per host (makespan over
the ideal of 50 sleeps in a row).
"""

from __future__ import annotations

import statistics
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

from benchmarks.hosts import Sync, add_sync, three_hosts, with_journal
from benchmarks.machine import parser, print_report
from benchmarks.stopping import run
from rosrm.config.settings import HostConfig
from rosrm.errors import RosrmError
from rosrm.model.values import Kind, ProcessSpec
from rosrm.testing.local_cluster import LocalCluster

_TRUE = 300
_SLEEPS, _SLEEP_S = 150, 0.1


def makespan(cluster: LocalCluster, specs: Sequence[ProcessSpec]) -> float:
    """Return the seconds from the call of `submit` to the last end, by the master's record."""
    before = cluster.client.list().last_sequence
    started = time.time()
    cluster.client.submit(specs)
    wait_for_all(cluster, specs)
    events = cluster.client.list(events=True, after=before, newest=10_000).events
    last = max(event.wall_time for event in events if event.kind == "finished")
    return last - started


def wait_for_all(
    cluster: LocalCluster, specs: Sequence[ProcessSpec], timeout: float = 120.0
) -> None:
    """Poll one process after the other, last first: listing all would distort the measurement."""
    deadline = time.monotonic() + timeout
    waiting = [spec.name for spec in specs]
    while waiting:
        (row,) = cluster.client.list(processes=True, process=waiting[-1]).processes
        if row.state == "finished":
            waiting.pop()
            continue
        if row.state == "failed":
            raise RosrmError(f"{row.name} failed: {row.reason}")
        if time.monotonic() >= deadline:
            raise TimeoutError(f"{row.name} did not finish in {timeout:g} s: it is {row.state}")
        cluster.client.spin(0.02)


def measure(
    hosts: Sequence[HostConfig], specs: Sequence[ProcessSpec], sync: Sync = "normal"
) -> float:
    """Return the makespan on a fresh cluster, after a warm-up of thirty jobs."""
    with (
        tempfile.TemporaryDirectory(prefix="rosrm-throughput-") as folder,
        LocalCluster(Path(folder), cluster=with_journal(sync), hosts=hosts) as cluster,
    ):
        makespan(cluster, [_job(f"warm{i}", "true") for i in range(30)])
        return makespan(cluster, specs)


def _job(name: str, *command: str) -> ProcessSpec:
    return ProcessSpec(name, command=command, kind=Kind.JOB)


def main() -> None:
    """Measure and print one JSON object."""
    command_line = parser(__doc__)
    command_line.add_argument("--runs", type=int, default=5, help="clusters for each measurement")
    add_sync(command_line)
    arguments = command_line.parse_args()
    runs, sync = arguments.runs, arguments.sync
    jobs = [_job(f"true{i}", "true") for i in range(_TRUE)]
    sleeps = [_job(f"sleep{i}", "sleep", str(_SLEEP_S)) for i in range(_SLEEPS)]
    ideal = _SLEEPS / 3 * _SLEEP_S
    rates, ratios = [], []
    for _ in range(runs):
        rates.append(_TRUE / measure(three_hosts(), jobs, sync))
        ratios.append(measure(three_hosts(max_processes=1), sleeps, sync) / ideal)
    print_report(
        "throughput",
        {
            "sync": sync, "jobs_per_s": statistics.median(rates), "jobs_per_s_all": rates,
            "makespan_over_ideal": statistics.median(ratios), "makespan_over_ideal_all": ratios,
        },
        runs=runs,
    )  # fmt: skip


if __name__ == "__main__":
    sys.exit(run("throughput", main))
