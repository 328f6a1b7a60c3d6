"""Time from the call of `submit` to the running process, compared with a bare spawn.

One process runs at a time: `date`, which prints the time as its first action. The bare spawn starts
the same program by Python's subprocess, in the same run. With `--trace` each start is traced, and
the report has the medians of the hand-overs (docs/explanation/latency.md).
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path

import numpy as np

from benchmarks.hosts import add_sync, three_hosts, with_journal
from benchmarks.machine import parser, print_report, say
from benchmarks.peers.work import STAMP
from benchmarks.stopping import run
from rosrm.cli.output import start_traces, tables
from rosrm.client.start_traces import Trace, hand_overs, submit_traced
from rosrm.errors import Refused
from rosrm.model.values import Kind, ProcessSpec
from rosrm.slave.logs import newest_instance
from rosrm.supervisor.client import log_path
from rosrm.testing.local_cluster import LocalCluster

_NS_PER_MS = 1e6


def bare_spawn_ms(folder: Path) -> float:
    """Return the milliseconds from the call to the stamp of a process without rosrm."""
    out = folder / "bare"
    with out.open("wb") as sink:
        called = time.time_ns()
        process = subprocess.Popen(
            STAMP, stdin=subprocess.DEVNULL, stdout=sink, stderr=sink, start_new_session=True
        )
    process.wait(10.0)
    return (int(out.read_text()) - called) / _NS_PER_MS


def submitted_ms(cluster: LocalCluster, number: int) -> float:
    """Return the milliseconds from the call of `submit` to the stamp of the process."""
    name = f"stamp{number}"
    called = time.time_ns()
    cluster.client.submit([ProcessSpec(name, command=STAMP, kind=Kind.JOB)])
    _wait_for_end(cluster, name)
    return (_stamp_of(cluster, name) - called) / _NS_PER_MS


def traced(cluster: LocalCluster, number: int) -> Trace:
    """Return the stamps of one start."""
    spec = ProcessSpec(f"traced{number}", command=STAMP, kind=Kind.JOB)
    (trace,) = submit_traced(cluster.client, [spec], timeout=10.0, notify=say).values()
    return trace


def _wait_for_end(cluster: LocalCluster, name: str, timeout: float = 10.0) -> None:
    """Wait for a job's end; poll seldom, so that polling does not affect the measurement."""
    deadline = time.monotonic() + timeout
    while True:
        cluster.client.spin(0.02)
        (row,) = cluster.client.list(processes=True, process=name).processes
        if row.state == "finished":
            return
        if time.monotonic() >= deadline:
            raise TimeoutError(f"{name} did not finish in {timeout:g} s: it is {row.state}")


def _stamp_of(cluster: LocalCluster, name: str) -> int:
    for host in cluster.slaves:
        state = cluster.directory / "hosts" / host / "supervisor"
        with suppress(Refused):
            return int(log_path(state, newest_instance(state, name)).read_text())
    raise FileNotFoundError(f"no slave has a log of {name}")


def main() -> None:
    """Measure and print one JSON object."""
    command_line = parser(__doc__)
    command_line.add_argument("--runs", type=int, default=300, help="processes that are measured")
    command_line.add_argument("--warm-up", type=int, default=20, help="processes before them")
    command_line.add_argument(
        "--trace", action="store_true", help="trace each start, and report its hand-overs"
    )
    add_sync(command_line)
    arguments = command_line.parse_args()
    with tempfile.TemporaryDirectory(prefix="rosrm-latency-") as folder:
        directory = Path(folder)
        settings = with_journal(arguments.sync)
        with LocalCluster(directory, cluster=settings, hosts=three_hosts()) as cluster:
            spawns, totals, traces = list[float](), list[float](), list[Trace]()
            for number in range(arguments.warm_up + arguments.runs):
                # Interleaved: other load on the machine affects both alike.
                spawns.append(bare_spawn_ms(directory))
                if arguments.trace:
                    traces.append(traced(cluster, number))
                else:
                    totals.append(submitted_ms(cluster, number))
    warm = slice(arguments.warm_up, None)
    spawns, totals, traces = spawns[warm], totals[warm], traces[warm]
    if traces:
        totals = [(one["process_started"] - one["client_sent"]) / _NS_PER_MS for one in traces]
        tables.show(start_traces.table(traces))
    print_report(
        "latency",
        {
            "sync": arguments.sync,
            "p50_ms": float(np.percentile(totals, 50)),
            "p99_ms": float(np.percentile(totals, 99)),
            "spawn_p50_ms": float(np.percentile(spawns, 50)),
            "spawn_p99_ms": float(np.percentile(spawns, 99)),
            "beyond_spawn_p50_ms": float(np.percentile(totals, 50) - np.percentile(spawns, 50)),
            **({"hand_overs": [asdict(row) for row in hand_overs(traces)]} if traces else {}),
        },
        runs=arguments.runs,
    )


if __name__ == "__main__":
    sys.exit(run("latency", main))
