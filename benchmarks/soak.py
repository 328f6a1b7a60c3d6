"""Growth of every part of a cluster over many jobs: memory, descriptors, threads and files.

Two hosts with a gateway, `rosrm alerts run` and a client that watches the events. Jobs are
submitted in batches; between them a process moves to the other host, or a new version of an
application is applied. After the warm-up each batch ends with a sample of each part. Then, in
further batches, a slave or the master is killed and started again each time; there the slopes are
those of the other parts. A slope is the median of the slopes of all pairs of samples (Theil and
Sen), by which one sample during an activity changes little.

- `uss_bytes_a_job`, `descriptors_a_1000_jobs`, `threads_a_1000_jobs`: of each part. USS counts the
  pages that no other process has.
- `pss_bytes_a_job`: the same with each page that N processes share as 1/N; so it also grows when
  another program that runs Python ends on this machine.
- `file_bytes_a_job`: of the state directory of each part, and of the master's journal.

The master keeps `--keep-ended` ended processes and ten times as many events on purpose, a slave and
a supervisor the names of 2,000 ended processes. The warm-up should be longer than all of them.
"""

from __future__ import annotations

import argparse
import contextlib
import http.client
import signal
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from os import environ
from pathlib import Path
from typing import Any, Final

import psutil
from scipy.stats import theilslopes

from benchmarks.apply import wait_until_it_runs
from benchmarks.hosts import three_hosts
from benchmarks.machine import parser, print_report, say
from benchmarks.slave_cost import supervisor_of
from benchmarks.stopping import run
from benchmarks.throughput import wait_for_all
from benchmarks.web import gateway
from rosrm.config.settings import ClusterConfig
from rosrm.model.applications import RolloutPolicy, Target
from rosrm.model.values import Kind, MigrationPolicy, ProcessSpec
from rosrm.testing.local_cluster import LocalCluster

#: Jobs of a batch; each batch ends with a sample.
_BATCH: Final = 100
#: Seconds for one activity to end.
_PATIENCE: Final = 120.0
_MOVED: Final = "moved"
_APPLICATION: Final = "versions"
#: All processes together, each without a time in which it has to prove itself.
_AT_ONCE: Final = RolloutPolicy(max_parallel=3, healthy_for=0.0)
_ALERTS: Final = """
sinks: {log: {use: command, command: ["true"]}}
alerts: {failing: {when: {event: failed, count: 3, within: 10min}, to: log}}
"""


@dataclass
class Samples:
    """Values of each figure of each part, with the number of jobs at their time."""

    jobs: list[int] = field(default_factory=list)
    values: dict[tuple[str, str], list[float]] = field(default_factory=dict)

    def add(self, jobs: int, parts: Mapping[str, psutil.Process], state: Path) -> None:
        """Measure all parts and their files."""
        self.jobs.append(jobs)
        for part, process in parts.items():
            with process.oneshot():
                memory = process.memory_full_info()
                self._add(part, "uss", memory.uss)
                self._add(part, "pss", memory.pss)
                self._add(part, "descriptors", process.num_fds())
                self._add(part, "threads", process.num_threads())
        for directory in [state / "master", *sorted((state / "hosts").iterdir())]:
            self._add(directory.name, "files", _size(directory))

    def _add(self, part: str, figure: str, value: float) -> None:
        self.values.setdefault((part, figure), []).append(value)

    def slope(self, part: str, figure: str) -> float:
        """Return the growth for each job."""
        return float(theilslopes(self.values[part, figure], self.jobs).slope)

    def growth(self, parts: Sequence[str]) -> dict[str, dict[str, float]]:
        """Return the slopes, in the units of the report."""
        units = {
            "uss_bytes_a_job": ("uss", 1.0),
            "pss_bytes_a_job": ("pss", 1.0),
            "descriptors_a_1000_jobs": ("descriptors", 1e3),
            "threads_a_1000_jobs": ("threads", 1e3),
            "file_bytes_a_job": ("files", 1.0),
        }
        return {
            name: {
                part: round(unit * self.slope(part, figure), 2)
                for part in parts
                if (part, figure) in self.values
            }
            for name, (figure, unit) in units.items()
        }


def _size(directory: Path) -> int:
    """Return the bytes of all files below a directory, from which files may disappear."""
    total = 0
    for path in directory.rglob("*"):
        try:
            total += path.lstat().st_size
        except FileNotFoundError:
            continue
    return total


class Soak:
    """One cluster, what watches it, and the work that it gets.

    Attributes:
        jobs: number of jobs so far.
    """

    def __init__(self, opened: ExitStack, folder: Path, keep_ended: int) -> None:
        self.jobs = 0
        self.directory = folder / "cluster"
        self.hosts = three_hosts()[:2]
        settings = ClusterConfig()
        journal = replace(settings.journal, keep_ended=keep_ended, keep_events=10 * keep_ended)
        settings = replace(settings, journal=journal)
        self.cluster = opened.enter_context(
            LocalCluster(self.directory, cluster=settings, hosts=self.hosts)
        )
        self.watching = dict(self._watchers(opened, folder))
        self.cluster.client.submit([_service(_MOVED, "inf")])
        self.versions, self.moves = 0, 0
        self.apply()
        self._wait(_MOVED)

    def _watchers(self, opened: ExitStack, folder: Path) -> Iterator[tuple[str, psutil.Process]]:
        gate, port = opened.enter_context(gateway(self.cluster))
        yield "gateway", gate
        page = http.client.HTTPConnection("127.0.0.1", port, timeout=_PATIENCE)
        page.request("GET", "/v1/changes")
        reader = threading.Thread(target=_read_all, args=[page.getresponse()], daemon=True)
        reader.start()
        alerts = folder / "alerts.yaml"
        alerts.write_text(_ALERTS)
        words = ("alerts", "run", str(alerts), "--state", str(folder / "alerts"))
        yield "alerts", opened.enter_context(_command(self.cluster, folder, *words))
        yield "events", opened.enter_context(_command(self.cluster, folder, "events", "-f"))

    def parts(self) -> dict[str, psutil.Process]:
        """Return the processes of all parts."""
        assert self.cluster.master is not None
        found = {"master": psutil.Process(self.cluster.master.process.pid)}
        for name, slave in self.cluster.slaves.items():
            found[f"slave {name}"] = psutil.Process(slave.process.pid)
            directory = self.directory / "hosts" / name
            found[f"supervisor {name}"] = supervisor_of(found[f"slave {name}"], directory)
        return found | self.watching

    def batch(self) -> None:
        """Run a batch of jobs to their ends."""
        numbers = range(self.jobs, self.jobs + _BATCH)
        specs = [ProcessSpec(f"job{n}", command=("true",), kind=Kind.JOB) for n in numbers]
        self.cluster.client.submit(specs)
        wait_for_all(self.cluster, specs, _PATIENCE)
        self.jobs += _BATCH

    def move(self) -> None:
        """Move a process to the other host."""
        source = self.cluster.process(_MOVED).host
        (other,) = (one.host for one in self.hosts if one.host != source)
        self.cluster.client.migrate(_MOVED, other)
        self._wait(_MOVED, other)
        self.moves += 1

    def apply(self) -> None:
        """Apply a new version of an application of three processes."""
        self.versions += 1
        seconds = str(10**6 + self.versions)
        specs = tuple(
            replace(_service(f"{_APPLICATION}_{number}", seconds), application=_APPLICATION)
            for number in range(3)
        )
        self.cluster.client.apply([Target(_APPLICATION, specs, rollout=_AT_ONCE)])
        wait_until_it_runs(self.cluster, _APPLICATION)

    def restart(self, number: int) -> None:
        """Kill a slave or the master, by turns, and start it again."""
        killed = (signal.SIGKILL, signal.SIGTERM)[number % 2]
        target = (number // 2) % (1 + len(self.hosts))
        if target == 0:
            assert self.cluster.master is not None
            self.cluster.master.end(killed)
            self.cluster.master.process.wait(_PATIENCE)
            self.cluster.start_master()
        else:
            slave = self.cluster.slaves[self.hosts[target - 1].host]
            slave.end(killed)
            slave.process.wait(_PATIENCE)
            self.cluster.start_slave(self.hosts[target - 1])
        self.cluster.wait_for_hosts(_PATIENCE)

    def _wait(self, name: str, host: str = "") -> None:
        self.cluster.wait_until(
            f"{name} running on {host or 'a host'}",
            lambda view: any(
                row.name == name and row.state == "running" and host in (row.host, "")
                for row in view.processes
            ),
            _PATIENCE,
        )


def _read_all(stream: http.client.HTTPResponse) -> None:
    """Read the changes as a page in a browser does, until the gateway ends."""
    with stream, contextlib.suppress(OSError, http.client.HTTPException):
        while stream.read1(1 << 16):
            pass


def _service(name: str, seconds: str) -> ProcessSpec:
    """Return a process that sleeps and that moves by a start at its destination."""
    return ProcessSpec(name, command=("sleep", seconds), migration=MigrationPolicy("relaunch"))


@contextlib.contextmanager
def _command(cluster: LocalCluster, folder: Path, *words: str) -> Iterator[psutil.Process]:
    """Run a command of rosrm beside the cluster."""
    variables = {**environ, **cluster.ros.environment()}
    argv = [sys.executable, "-m", "rosrm.cli", *words]
    with (
        (folder / f"{words[0]}.log").open("wb") as log,
        subprocess.Popen(argv, env=variables, stdout=log, stderr=log) as process,
    ):
        try:
            yield psutil.Process(process.pid)
        finally:
            process.send_signal(signal.SIGINT)


def measure(arguments: argparse.Namespace, folder: Path) -> dict[str, Any]:
    """Return the growth of all parts; raises `TimeoutError` if the work does not end."""
    steady, restarted = Samples(), Samples()
    with ExitStack() as opened:
        soak = Soak(opened, folder, arguments.keep_ended)
        batches = arguments.jobs // _BATCH
        for number in range(batches):
            soak.batch()
            for _ in range(_share(arguments.moves, number, batches)):
                soak.move()
            for _ in range(_share(arguments.applies, number, batches)):
                soak.apply()
            if soak.jobs > arguments.warm_up:
                steady.add(soak.jobs, soak.parts(), soak.directory)
            if number % 10 == 9:
                say(f"benchmarks.soak: {soak.jobs} jobs, {soak.moves} moves")
        if arguments.restarts:
            say(f"benchmarks.soak: {steady.growth([*soak.parts()])}")
        for number in range(arguments.restarts):
            soak.restart(number)
            soak.batch()
            restarted.add(soak.jobs, soak.parts(), soak.directory)
        parts = [*soak.parts(), *(one.host for one in soak.hosts)]
    kept = [one for one in parts if one != "master" and not one.startswith("slave ")]
    return {
        **steady.growth(parts),
        "over_restarts": restarted.growth(kept) if arguments.restarts > 1 else {},
        "pss_mb": {
            part: round(values[-1] / 1e6, 1)
            for (part, figure), values in steady.values.items()
            if figure == "pss"
        },
    }


def _share(total: int, number: int, batches: int) -> int:
    """Return how many of all activities follow a batch, so that they are spread evenly."""
    return total * (number + 1) // batches - total * number // batches


def options() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    command_line = parser(__doc__)
    for name, default, what in (
        ("--jobs", 30_000, "jobs without a restart of a part"),
        ("--moves", 500, "moves of a process between two hosts"),
        ("--applies", 200, "versions of an application"),
        ("--restarts", 50, "restarts of the master and the slaves, with 100 jobs after each"),
        ("--warm-up", 10_000, "jobs before the first sample"),
        ("--keep-ended", 2_000, "ended processes that the master keeps"),
    ):
        command_line.add_argument(name, type=int, default=default, help=what)
    return command_line


def main() -> None:
    """Measure and print one JSON object."""
    arguments = options().parse_args()
    with tempfile.TemporaryDirectory(prefix="rosrm-soak-") as folder:
        figures = measure(arguments, Path(folder))
    print_report("soak", {**vars(arguments), **figures}, runs=1)


if __name__ == "__main__":
    sys.exit(run("soak", main))
