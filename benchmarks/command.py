"""Seconds and CPU time of a read-only command, from its start to its end."""

from __future__ import annotations

import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from benchmarks.hosts import three_hosts
from benchmarks.machine import parser, print_report
from benchmarks.stopping import run
from rosrm.testing.local_cluster import LocalCluster

_COMMANDS = (("ps",), ("hosts",), ("status",), ("events",))
_TIMEOUT = 10.0


def measure(command: tuple[str, ...], environment: dict[str, str]) -> tuple[float, float]:
    """Run a command once; return the seconds that passed and those of CPU.

    The output goes to a pipe, because `subprocess.run` then notices the end at once; otherwise it
    polls every 0.05 s.
    """
    before, began = _cpu(), time.monotonic()
    subprocess.run(
        [sys.executable, "-m", "rosrm.cli", *command], env=environment, stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE, check=True, timeout=_TIMEOUT,
    )  # fmt: skip
    return time.monotonic() - began, _cpu() - before


def _cpu() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def main() -> None:
    """Measure and print one JSON object."""
    command_line = parser(__doc__)
    command_line.add_argument("--runs", type=int, default=10, help="runs of each command")
    arguments = command_line.parse_args()
    with (
        tempfile.TemporaryDirectory(prefix="rosrm-command-") as folder,
        LocalCluster(Path(folder), hosts=three_hosts()) as cluster,
    ):
        environment = {**os.environ, **cluster.ros.environment()}
        measured = [
            measure(command, environment) for _ in range(arguments.runs) for command in _COMMANDS
        ]
    seconds, cpu = zip(*measured, strict=True)
    print_report(
        "command",
        {
            "p50_s": float(np.percentile(seconds, 50)),
            "p90_s": float(np.percentile(seconds, 90)),
            "max_s": max(seconds),
            "cpu_p50_s": float(np.percentile(cpu, 50)),
        },
        runs=len(measured),
    )


if __name__ == "__main__":
    sys.exit(run("command", main))
