"""rosrm: a job for each process, on a master and three slaves, with keys and a journal."""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from pathlib import Path
from typing import Any

from benchmarks import latency, throughput
from benchmarks.hosts import three_hosts
from benchmarks.peers import work
from benchmarks.stopping import own_keys
from rosrm.model.values import Kind, ProcessSpec
from rosrm.testing.local_cluster import LocalCluster

_WARM_UP = 20
_LONGEST_S = 300.0


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
        LocalCluster(Path(folder) / "cluster", hosts=three_hosts()) as cluster,
    ):
        files = [Path(folder) / str(number) for number in range(count)]
        end = Path(folder) / "end"
        specs = [
            _job(f"holder{number}", *work.holder(40, str(one), str(end)))
            for number, one in enumerate(files)
        ]
        began = time.time_ns()
        cluster.client.submit(specs)
        newest = work.wait_for_files(files, _LONGEST_S)
        end.touch()
        return (newest - began) / 1e9


def _job(name: str, *command: str) -> ProcessSpec:
    return ProcessSpec(name, command=command, kind=Kind.JOB)


_MEASUREMENTS: dict[str, Any] = {
    "stamps": stamps, "jobs": jobs, "sleeps": sleeps, "holders": holders,
}  # fmt: skip


def main() -> None:
    """Carry out the measurement that the arguments name, and print its result."""
    parser = argparse.ArgumentParser()
    parser.add_argument("measurement", choices=sorted(_MEASUREMENTS))
    parser.add_argument("--count", type=int, required=True)
    options = parser.parse_args()
    with own_keys():
        result = _MEASUREMENTS[options.measurement](options.count)
    print(json.dumps(result), flush=True)


if __name__ == "__main__":
    main()
