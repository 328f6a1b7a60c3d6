"""Time of `rosrm apply` for an application of 1,000 processes on 100 hosts.

The master is the real one; the slaves are simulated (`benchmarks/simulated_slaves.py`), and report
every process as ready. One client measures, from its call to the answer:

- `unchanged_ms`: apply of the application as it is.
- `plan_ms`: plan of the same file with 100 changed processes; each run has other changes.
- `check_ms`: reading and checking the file of the application, in this process.

Each is the median of the runs.
"""

from __future__ import annotations

import statistics
import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from pathlib import Path

from benchmarks.machine import isolated_transports, parser, print_report, say
from benchmarks.scale import Crowd
from benchmarks.stopping import run
from rosrm.config.work import load_application
from rosrm.errors import RosrmError
from rosrm.model.applications import Target
from rosrm.testing.local_cluster import LocalCluster

_PROCESSES, _CHANGES, _HOSTS = 1000, 100, 100
#: Seconds for all slaves to register, and for all processes to run.
_PATIENCE = 120.0


def written(folder: Path) -> Path:
    """Write the file of the application."""
    entry = """
  - name: worker{number}
    command: [worker, --number, "{number}"]
    needs: {{memory: 10MB, cpu: 0.01}}
    priority: {priority}
    migration: relaunch
    restart: on-failure
"""
    entries = (entry.format(number=one, priority=one % 3) for one in range(_PROCESSES))
    path = folder / "fleet.yaml"
    path.write_text(f"app: fleet\nprocesses:{''.join(entries)}")
    return path


def changed(target: Target, number: int) -> Target:
    """Return the target with other arguments of some processes, which are replaced then."""
    arguments = ("--run", str(number))
    some = (replace(spec, arguments=arguments) for spec in target.specs[:_CHANGES])
    return replace(target, specs=(*some, *target.specs[_CHANGES:]))


def milliseconds(call: Callable[[], object]) -> float:
    """Return the milliseconds of a call."""
    called = time.perf_counter()
    call()
    return (time.perf_counter() - called) * 1e3


def wait_until_it_runs(cluster: LocalCluster, application: str) -> None:
    """Wait until all processes of an application run.

    Raises:
        RosrmError: they do not in time.
    """
    deadline = time.monotonic() + _PATIENCE
    while True:
        rows = cluster.client.list(applications=True).applications
        (row,) = [one for one in rows if one.name == application]
        if row.state == "running":
            return
        if time.monotonic() >= deadline:
            raise RosrmError(f"{row.running} of {row.processes} run after {_PATIENCE:g} s")
        cluster.client.spin(0.5)


def measure(cluster: LocalCluster, path: Path, runs: int) -> dict[str, list[float]]:
    """Return the milliseconds of each run by figure."""
    target, client = load_application(path), cluster.client
    client.apply([target])
    say("benchmarks.apply: waiting until all processes run")
    wait_until_it_runs(cluster, target.application)
    found: dict[str, list[float]] = {"unchanged_ms": [], "plan_ms": [], "check_ms": []}
    for number in range(runs):
        found["check_ms"].append(milliseconds(lambda: load_application(path)))
        found["unchanged_ms"].append(milliseconds(lambda: client.apply([target])))
        plan = partial(client.apply, [changed(target, number)], plan_only=True)
        found["plan_ms"].append(milliseconds(plan))
    return found


def main() -> None:
    """Measure and print one JSON object."""
    command_line = parser(__doc__)
    command_line.add_argument("--runs", type=int, default=20, help="runs of each measurement")
    runs = command_line.parse_args().runs
    transports = isolated_transports()
    with tempfile.TemporaryDirectory(prefix="rosrm-apply-") as folder, ExitStack() as stack:
        cluster = stack.enter_context(LocalCluster(Path(folder), hosts=[]))
        cluster.client.list()  # the master runs, and has made the keys of its hosts
        assert cluster.domain is not None
        crowd = Crowd(cluster.domain, hz=1.0, step=0.0, timeout=_PATIENCE)
        stack.callback(crowd.close)
        crowd.start(_HOSTS, 2)
        found = measure(cluster, written(Path(folder)), runs)
    medians = {name: round(statistics.median(values), 1) for name, values in found.items()}
    print_report(
        "apply",
        {
            **medians, "processes": _PROCESSES, "changes": _CHANGES, "hosts": _HOSTS,
            "transports": transports,
        },
        runs=runs,
    )  # fmt: skip


if __name__ == "__main__":
    sys.exit(run("apply", main))
