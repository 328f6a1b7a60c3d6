"""Spread of sixty equal processes, submitted at once, over three equal hosts."""

from __future__ import annotations

import sys
import tempfile
from collections import Counter
from pathlib import Path

from benchmarks.hosts import three_hosts
from benchmarks.machine import parser, print_report
from benchmarks.stopping import run
from rosrm.model.values import ProcessSpec
from rosrm.testing.local_cluster import LocalCluster

_PROCESSES = 60


def placed() -> dict[str, int]:
    """Return the number of processes by host, once all of them run."""
    specs = [ProcessSpec(f"equal{i}", command=("sleep", "600")) for i in range(_PROCESSES)]
    with (
        tempfile.TemporaryDirectory(prefix="rosrm-balance-") as folder,
        LocalCluster(Path(folder), hosts=three_hosts()) as cluster,
    ):
        cluster.client.submit(specs)
        view = cluster.wait_until(
            f"{_PROCESSES} processes running",
            lambda view: sum(row.state == "running" for row in view.processes) == _PROCESSES,
        )
        return dict(sorted(Counter(row.host for row in view.processes).items()))


def main() -> None:
    """Measure and print one JSON object."""
    command_line = parser(__doc__)
    command_line.add_argument("--runs", type=int, default=3, help="number of clusters")
    runs = command_line.parse_args().runs
    outcomes = [placed() for _ in range(runs)]
    widest = max(outcomes, key=lambda one: max(one.values()) - min(one.values()))
    print_report(
        "balance",
        {
            "per_host": widest, "spread": max(widest.values()) - min(widest.values()),
            "all": outcomes,
        },
        runs=runs,
    )  # fmt: skip


if __name__ == "__main__":
    sys.exit(run("balance", main))
