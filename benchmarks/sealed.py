"""Cost of keys: clusters with `security: keys` and with `security: none`, compared in one run.

- `latency_p50_ms`, `latency_p99_ms`: from the call of `submit` to the running process, one at a
  time, on three hosts; both clusters are up, and the jobs alternate between them.
- `us_per_slave_cycle`: CPU of the master per cycle of a simulated slave, as `benchmarks.scale`
  measures it, with one cluster after the other.
- `handoff_gap_p50_ms`: time without output beyond one period while a stateful node moves, as
  `benchmarks.handoff` measures it, with one cluster after the other.
- `slave_cpu_s_per_minute`: CPU of one slave with five idle processes, without its supervisor; both
  slaves at the same time.

For each figure: the values of both, their ratio, the most that `keys` may be by the goal, and
whether the goal is reached. Of several rounds the median counts.
"""

from __future__ import annotations

import argparse
import contextlib
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from statistics import median
from typing import Any, Final

import psutil

from benchmarks import handoff, scale
from benchmarks.hosts import three_hosts
from benchmarks.latency import submitted_ms
from benchmarks.machine import isolated_transports, parser, percentile, print_report, say
from benchmarks.simulated_slaves import STEP
from benchmarks.slave_cost import cpu_seconds
from benchmarks.stopping import run
from rosrm.config.settings import ClusterConfig, HostConfig
from rosrm.keys.roles import SecurityMode
from rosrm.model.values import ProcessSpec
from rosrm.testing.local_cluster import LocalCluster

#: A figure of both clusters.
Pair = dict[SecurityMode, float]

_MODES: Final[tuple[SecurityMode, ...]] = ("none", "keys")
#: The most that a figure may be with keys: so many times the one without, and so much more.
_GOALS: Final[Mapping[str, tuple[float, float]]] = {
    "latency_p50_ms": (1.1, 0.0),
    "latency_p99_ms": (1.1, 0.0),
    "us_per_slave_cycle": (1.0, 4.0),
    "handoff_gap_p50_ms": (1.0, 1.0),  # unchanged, up to the noise of the measurement
    "slave_cpu_s_per_minute": (1.15, 0.0),
}
_WARM_UP: Final = 20
_IDLE_PROCESSES: Final = 5
#: Hz, of the inputs of the node that moves.
_RATE: Final = 50.0
#: Seconds after the start of the processes, before the CPU of their slaves is measured.
_SETTLE: Final = 5.0


@contextlib.contextmanager
def both(hosts: Sequence[HostConfig]) -> Iterator[dict[SecurityMode, LocalCluster]]:
    """Run a cluster with keys and one without."""
    with contextlib.ExitStack() as opened:
        folder = Path(opened.enter_context(tempfile.TemporaryDirectory(prefix="rosrm-sealed-")))
        yield {
            mode: opened.enter_context(
                LocalCluster(folder / mode, ClusterConfig(security=mode), hosts)
            )
            for mode in _MODES
        }


def latency(options: argparse.Namespace) -> dict[str, Pair]:
    """Return the latency of a job."""
    took: dict[SecurityMode, list[float]] = {mode: [] for mode in _MODES}
    with both(three_hosts()) as clusters:
        for number in range(_WARM_UP + options.jobs):
            for mode, cluster in clusters.items():
                took[mode].append(submitted_ms(cluster, number))
    return {
        f"latency_p{percent}_ms": {
            mode: percentile(took[mode][_WARM_UP:], percent / 100) for mode in _MODES
        }
        for percent in (50, 99)
    }


def slave_cycles(options: argparse.Namespace) -> dict[str, Pair]:
    """Return the CPU of the master per slave-cycle."""

    def cost(security: SecurityMode) -> float:
        with tempfile.TemporaryDirectory(prefix="rosrm-sealed-") as folder:
            return scale.measure(options, options.slaves, Path(folder), security)["us_per_message"]

    return {"us_per_slave_cycle": _by_turns(options.rounds, cost)}


def handoffs(options: argparse.Namespace) -> dict[str, Pair]:
    """Return the gap of a handoff."""

    def gap(security: SecurityMode) -> float:
        outcome = handoff.measure("handoff", "input", _RATE, options.moves, security)
        return 1e3 * median(outcome.gaps)

    return {"handoff_gap_p50_ms": _by_turns(options.rounds, gap)}


def slaves(options: argparse.Namespace) -> dict[str, Pair]:
    """Return the CPU of a slave with idle processes, in seconds per minute."""
    idle = [ProcessSpec(f"idle{i}", command=("sleep", "3600")) for i in range(_IDLE_PROCESSES)]
    with both(three_hosts()[:1]) as clusters:
        for cluster in clusters.values():
            cluster.client.submit(idle)
            cluster.wait_until(
                "idle processes running",
                lambda view: sum(row.state == "running" for row in view.processes) == len(idle),
            )
        parts = {mode: clusters[mode].slaves["host0"].process.pid for mode in _MODES}
        processes = {mode: [psutil.Process(pid)] for mode, pid in parts.items()}
        time.sleep(_SETTLE)
        before = {mode: cpu_seconds(processes[mode]) for mode in _MODES}
        time.sleep(options.rounds * options.seconds)
        minutes = options.rounds * options.seconds / 60.0
        return {
            "slave_cpu_s_per_minute": {
                mode: (cpu_seconds(processes[mode]) - before[mode]) / minutes for mode in _MODES
            }
        }


def _by_turns(rounds: int, measure: Callable[[SecurityMode], float]) -> Pair:
    """Return the medians of several rounds; other load on the machine affects both alike."""
    found: dict[SecurityMode, list[float]] = {mode: [] for mode in _MODES}
    for number in range(rounds):
        for mode in _MODES if number % 2 == 0 else reversed(_MODES):
            found[mode].append(measure(mode))
    return {mode: median(values) for mode, values in found.items()}


def judged(name: str, pair: Pair) -> dict[str, Any]:
    """Return a figure of both clusters beside its goal."""
    factor, more = _GOALS[name]
    most = factor * pair["none"] + more
    return {
        **{mode: round(value, 3) for mode, value in pair.items()},
        "ratio": round(pair["keys"] / pair["none"], 3) if pair["none"] > 0 else None,
        "at_most": round(most, 3),
        "reached": pair["keys"] <= most,
    }


_PARTS: Final = {
    "latency": latency, "scale": slave_cycles, "handoff": handoffs, "slave": slaves,
}  # fmt: skip


def main() -> None:
    """Measure and print one JSON object."""
    command_line = parser(__doc__)
    command_line.add_argument(
        "--parts", nargs="+", choices=tuple(_PARTS), default=list(_PARTS), help="to measure"
    )
    command_line.add_argument("--rounds", type=int, default=3, help="of each mode, by turns")
    command_line.add_argument("--jobs", type=int, default=300, help="of each mode, for latency")
    command_line.add_argument("--moves", type=int, default=20, help="of each handoff round")
    command_line.add_argument("--slaves", type=int, default=200, help="simulated slaves for scale")
    command_line.add_argument(
        "--seconds", type=float, default=30.0, help="of each round of scale and slave"
    )
    command_line.add_argument(
        "--settle", type=float, default=30.0, help="seconds before each round of scale"
    )
    # The rest of the options of `benchmarks.scale`.
    command_line.set_defaults(hz=10.0, step=STEP, processes=2, timeout=240.0, jobs=scale.JOBS)
    options = command_line.parse_args()
    transports = isolated_transports()
    figures: dict[str, Any] = {}
    for part in options.parts:
        for name, pair in _PARTS[part](options).items():
            figures[name] = judged(name, pair)
            say(f"{name}: {figures[name]}")
    print_report(
        "sealed",
        {
            **figures, "jobs": options.jobs, "moves": options.moves, "slaves": options.slaves,
            "transports": transports,
        },
        runs=options.rounds,
    )  # fmt: skip


if __name__ == "__main__":
    sys.exit(run("sealed", main))
