"""Seconds from the start of a master that was killed until its hosts get new work again.

The master is real, with a journal of 1,000 running processes; its slaves are simulated
(`benchmarks/simulated_slaves.py`). In each round the master gets SIGKILL, or SIGTERM by `--signal`,
and the next one is started on the same state directory. A client then submits one job for each
host. All times count from that start, and each figure is a median:

- `lock_s`: until the state directory is locked, after most imports.
- `restored_s`: until the journal is read: the time of the event `master_started`.
- `first_host_s`, `last_host_s`: until the first and the last host have registered.
- `first_assigned_s`, `placed_s`: until the first job is assigned, and until the slave of the last
  host has received its job.
"""

from __future__ import annotations

import argparse
import signal
import sys
import tempfile
import time
from contextlib import ExitStack
from pathlib import Path

import numpy as np

from benchmarks.machine import isolated_transports, parser, print_report, say
from benchmarks.scale import Crowd, occupied_cluster
from benchmarks.simulated_slaves import STEP
from benchmarks.stopping import run
from rosrm.config.settings import ProcessDefaults
from rosrm.errors import RosrmError
from rosrm.model.values import Kind, ProcessSpec
from rosrm.ros.master_connection import MasterClient
from rosrm.ros.participant import Participant
from rosrm.testing.local_cluster import LocalCluster

_PATIENCE = 120.0
#: Seconds after which the estimated needs of the processes no longer count as load.
_SETTLED = ProcessDefaults().settle + 1.0
#: Most events of one restart.
_EVENTS = 10_000
#: Seconds between the last assignment of a round and the next round.
_PAUSE = 1.0


def _restart(cluster: LocalCluster, number: signal.Signals) -> tuple[float, MasterClient]:
    """End the master and start it again; return the unix time of the start, and a new client.

    The participant of the client exists before the start, so that its creation takes no time from
    the master.
    """
    assert cluster.master is not None
    cluster.master.end(number)
    cluster.master.process.wait(_PATIENCE)
    participant = Participant(cluster.ros, "rosrm_restart")
    started = time.time()
    cluster.start_master()
    client = MasterClient.connect(
        cluster.ros, name="restart", timeout=_PATIENCE, joined=participant
    )
    return started, client


def _times(client: MasterClient, started: float, jobs: set[str]) -> dict[str, float]:
    """Return the times of a master's start and of what followed, in seconds from `started`."""
    newest = client.list(events=True, newest=_EVENTS).events
    events = [one for one in newest if one.wall_time >= started]
    begun = [one.wall_time for one in events if one.kind == "master_started"]
    hosts = [one.wall_time for one in events if one.kind == "host_registered"]
    assigned = [one.wall_time for one in events if one.kind == "assigned" and one.process in jobs]
    return {
        "restored_s": begun[0] - started,
        "first_host_s": min(hosts) - started,
        "last_host_s": max(hosts) - started,
        "first_assigned_s": min(assigned) - started,
    }


def _round(
    cluster: LocalCluster, crowd: Crowd, number: int, arguments: argparse.Namespace
) -> dict[str, float]:
    """Restart the master once, and return the measured times.

    Raises:
        RosrmError: a host got no job.
    """
    crowd.toggle()
    started, client = _restart(cluster, signal.Signals[f"SIG{arguments.signal}"])
    with client:
        jobs = {f"job_{number}_{host}": f"sim{host + 1:05d}" for host in range(arguments.hosts)}
        client.submit(
            [
                ProcessSpec(name, command=("true",), kind=Kind.JOB, required_labels={"host": host})
                for name, host in jobs.items()
            ]
        )
        _wait_for_ends(client, set(jobs))
        figures = _times(client, started, set(jobs))
    crowd.toggle()
    taken = {name: at for one in crowd.reports() for name, at in one["taken"].items()}
    if missing := jobs.keys() - taken:
        raise RosrmError(f"{len(missing)} of {len(jobs)} hosts got no job")
    lock = cluster.directory / "master" / "master.lock"
    return {
        "lock_s": lock.stat().st_mtime - started,
        **figures,
        "placed_s": max(taken[name] for name in jobs) - started,
    }


def _wait_for_ends(client: MasterClient, jobs: set[str]) -> None:
    deadline = time.monotonic() + _PATIENCE
    while True:
        rows = client.list(processes=True).processes
        ended = {row.name for row in rows if row.state == "finished"}
        if jobs <= ended:
            return
        if time.monotonic() >= deadline:
            raise RosrmError(f"{len(jobs - ended)} jobs did not end in {_PATIENCE:g} s")
        client.spin(_PAUSE)


def measure(arguments: argparse.Namespace, folder: Path) -> list[dict[str, float]]:
    """Return the times of all rounds; raises `RosrmError` if a part ends or a host gets no job."""
    with ExitStack() as opened:
        cluster, crowd = occupied_cluster(
            opened, folder, arguments.hosts, arguments.processes, STEP, _PATIENCE
        )
        cluster.client.spin(_SETTLED)
        rounds = []
        for number in range(arguments.runs):
            rounds.append(_round(cluster, crowd, number, arguments))
            say(str({name: round(value, 3) for name, value in rounds[-1].items()}))
        return rounds


def main() -> int:
    """Measure and print one JSON object; return the exit status."""
    command_line = parser(__doc__)
    command_line.add_argument("--hosts", type=int, default=20, help="number of simulated slaves")
    command_line.add_argument("--processes", type=int, default=1000, help="number of processes")
    command_line.add_argument("--runs", type=int, default=10, help="restarts of the master")
    command_line.add_argument(
        "--signal", choices=["KILL", "TERM"], default="KILL", help="signal that ends the master"
    )
    arguments = command_line.parse_args()
    transports = isolated_transports()
    with tempfile.TemporaryDirectory(prefix="rosrm-restart-") as folder:
        rounds = measure(arguments, Path(folder))
    figures = {name: float(np.median([one[name] for one in rounds])) for name in rounds[0]}
    print_report(
        "restart",
        {
            "hosts": arguments.hosts, "processes": arguments.processes,
            "signal": arguments.signal, **figures,
            "placed_worst_s": max(one["placed_s"] for one in rounds), "transports": transports,
        },
        runs=arguments.runs,
    )  # fmt: skip
    return 0


if __name__ == "__main__":
    sys.exit(run("restart", main))
