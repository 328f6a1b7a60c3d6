"""The master's whole decision in the core: filter, score, veto, pick, account.

Two figures, both through `rosrm.core.master.reducer.step` with the policy `weighted`, as in the
master's runtime, without the transport and the journal:

- `us_per_host`: one process is submitted right after fresh readings of all hosts, so that every
  host is evaluated again: microseconds from SubmissionReceived to the commands, per host. The
  paper's master took 84 us per slave for its whole cycle. `readings_us_per_host`: the cost of these
  readings.
- `assignments_per_s`: many processes are submitted at once; from SubmissionReceived to the
  commands, with the queue, the record and the intent of each. `assignments_per_s` is for equal
  processes, `mixed_assignments_per_s` for ten different demands by turns (such as the pieces of a
  map), where each assignment makes the scores of the other demands stale.
"""

from __future__ import annotations

import gc
import sys
import time
from collections.abc import Callable, Sequence
from statistics import median

import numpy as np

from benchmarks.machine import parser, print_report, say
from benchmarks.stopping import run
from rosrm.core.master import events as happened
from rosrm.core.master.commands import Assign
from rosrm.core.master.master_state import MasterState
from rosrm.core.master.reducer import step
from rosrm.core.master.settings import CoreSettings
from rosrm.model.values import RESOURCE_SLOTS, HostDescription, ProcessSpec, ResourceDescription
from rosrm_scoring.weighted import Weighted, WeightedOptions

_HOSTS = (10, 100, 1_000, 10_000)
_RESOURCES = ("memory", "cpu", "disk")
_LIMIT = 0.8
_AT_ONCE = 5_000
_DEMANDS = 10


class Bench:
    """A master's core with hosts that have room.

    Args:
        hosts: how many.
    """

    def __init__(self, hosts: int) -> None:
        self.now = 0.0
        self._names = 0
        self._sequence = 0
        self._hosts = hosts
        self._random = np.random.default_rng(hosts)
        weighted = Weighted(WeightedOptions())
        self.state = MasterState(CoreSettings(), "weighted", weighted, {}, epoch=1)
        described = tuple(
            ResourceDescription(name, unit, capacity)
            for name, unit, capacity in (
                ("memory", "B", 2.0**40), ("cpu", "core", 4096.0), ("disk", "B", 2.0**44),
            )
        )  # fmt: skip
        for number in range(hosts):
            description = HostDescription(f"h{number}", number + 1, resources=described)
            self.step(happened.HostRegistered(number, description))
        self.read()
        for number in range(hosts):
            self.step(happened.ProcessRequested(number, number + 1, number + 1))

    def step(self, event: happened.Event) -> tuple[float, int]:
        """Process an event; return the seconds that it took, and the number of assignments."""
        self.now += 0.001
        began = time.perf_counter()
        commands = step(self.state, event, self.now)
        took = time.perf_counter() - began
        return took, sum(isinstance(command, Assign) for command in commands)

    def read(self) -> float:
        """Process fresh readings of all hosts; return the seconds that it took."""
        self._sequence += 1
        n = self._hosts
        usage, limit = np.zeros((n, RESOURCE_SLOTS)), np.ones((n, RESOURCE_SLOTS))
        usage[:, : len(_RESOURCES)] = self._random.uniform(0.1, 0.5, (n, len(_RESOURCES)))
        limit[:, : len(_RESOURCES)] = _LIMIT
        ids = np.arange(1, n + 1)
        readings = happened.ReadingsReceived(
            host_id=ids, incarnation=ids.astype(np.uint64),
            sequence=np.full(n, self._sequence, np.uint64),
            status_sequence=np.zeros(n, np.uint64), accepting=np.ones(n, np.bool_),
            stale=np.zeros(n, np.uint32), usage=usage, limit=limit,
        )  # fmt: skip
        took, _ = self.step(readings)
        return took

    def submit(self, demands: Sequence[dict[str, float]]) -> tuple[float, int]:
        """Submit one process for each demand; return as `step`."""
        specs = []
        for needs in demands:
            self._names += 1
            name = f"p{self._names}"
            specs.append(ProcessSpec(name, package="maps", executable="map_piece", needs=needs))
        return self.step(happened.SubmissionReceived(1, tuple(specs)))


def decision(hosts: int, runs: int) -> tuple[float, float]:
    """Return the median microseconds by host of one decision, and of the readings before it."""
    bench = Bench(hosts)
    decisions, readings = [], []
    for _ in range(runs):
        readings.append(bench.read())
        took, assigned = bench.submit([{"memory": 2.0**26, "cpu": 0.1}])
        assert assigned == 1
        decisions.append(took)
    per_host = 1e6 / hosts
    return median(decisions) * per_host, median(readings) * per_host


def rate(hosts: int, runs: int, needs_of: Callable[[int], dict[str, float]]) -> float:
    """Return the median assignments a second of many processes submitted at once."""
    rates = []
    for _ in range(runs):
        bench = Bench(hosts)
        bench.submit([{"memory": 2.0**26}])
        gc.collect()
        took, assigned = bench.submit([needs_of(number) for number in range(_AT_ONCE)])
        assert assigned == _AT_ONCE
        rates.append(assigned / took)
    return median(rates)


def equal(_number: int) -> dict[str, float]:
    return {"memory": 2.0**26, "cpu": 0.1}


def mixed(number: int) -> dict[str, float]:
    kind = number % _DEMANDS
    return {"memory": (8 + 8 * kind) * 2.0**20, "cpu": 0.05 * (1 + kind)}


def main() -> None:
    command_line = parser(__doc__)
    command_line.add_argument("--runs", type=int, default=7, help="measurements of each figure")
    runs = command_line.parse_args().runs
    per_host, read, rates, mixed_rates = {}, {}, {}, {}
    for hosts in _HOSTS:
        us, readings = decision(hosts, 20 * runs)
        per_host[str(hosts)], read[str(hosts)] = round(us, 4), round(readings, 4)
        say(f"{hosts:6} hosts: {us:.4f} us a host for a decision, {readings:.4f} for its readings")
    for hosts in _HOSTS:
        rates[str(hosts)] = round(rate(hosts, runs, equal))
        mixed_rates[str(hosts)] = round(rate(hosts, runs, mixed))
        say(f"{hosts:6} hosts: {rates[str(hosts)]} equal, {mixed_rates[str(hosts)]} mixed a second")
    figures = {
        "us_per_host": per_host, "assignments_per_s": rates,
        "mixed_assignments_per_s": mixed_rates, "readings_us_per_host": read,
    }  # fmt: skip
    print_report("decide", figures, runs=runs)


if __name__ == "__main__":
    sys.exit(run("decide", main))
