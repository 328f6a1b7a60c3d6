"""Cost of a control group for the start of an instance.

The supervisor's own code starts `true` by turns: without a group, in a group of its own, and in one
with limits of memory and CPU. Reported are the milliseconds until the process runs (`start`), and
until its group is removed after its end (`end`). Needs the right to make groups.
"""

from __future__ import annotations

import os
import statistics
import sys
import tempfile
import time

from benchmarks.machine import parser, print_report
from benchmarks.stopping import run
from rosrm.core.supervisor.rules import LimitRule
from rosrm.supervisor import spawn
from rosrm.supervisor.confinement import Confinement
from rosrm.supervisor.instance_groups import InstanceGroups

_LIMITS = LimitRule(memory=5e8, cpu=1.5)


def main() -> None:
    """Measure and print one JSON object."""
    options = parser(__doc__)
    options.add_argument("--rounds", type=int, default=300, help="starts of each kind")
    given = options.parse_args()
    with tempfile.TemporaryDirectory() as state:
        confined, plain = Confinement(state), Confinement(state)
        plain.groups = InstanceGroups()
        if {"limits.memory", "limits.cpu"} & confined.missing.keys():
            print(f"start_cost: {confined.missing}", file=sys.stderr)
            sys.exit(2)
        kinds = {
            "plain": (plain, LimitRule()), "group": (confined, LimitRule()),
            "limits": (confined, _LIMITS),
        }  # fmt: skip
        times: dict[str, list[tuple[float, float]]] = {kind: [] for kind in kinds}
        for number in range(given.rounds):
            for kind, (confinement, limits) in kinds.items():
                times[kind].append(one_start(confinement, number, limits))
        confined.groups.close()
        trees = [f"version {one.version}: {', '.join(one.controllers)}"
                 for one in confined.groups.trees]  # fmt: skip
    figures: dict[str, object] = {"trees": trees}
    for name, at in (("start", 0), ("end", 1)):
        found = {kind: [value[at] for value in values] for kind, values in times.items()}
        for quantile, part in (("p10", 10), ("p50", 2)):
            figures[f"{name}_ms_{quantile}"] = {
                kind: round(statistics.quantiles(one, n=part)[0], 3) for kind, one in found.items()
            }
    print_report("start_cost", figures, runs=given.rounds)


def one_start(confinement: Confinement, number: int, limits: LimitRule) -> tuple[float, float]:
    """Start one process; return the milliseconds of its start, and of the removal of its group."""
    null = os.open(os.devnull, os.O_RDWR | os.O_CLOEXEC)
    path = {"PATH": os.defpath}

    def start(group: int, scheduler: spawn.Scheduler | None) -> spawn.Attempt:
        program = spawn.Program(("true",), path, "/")
        return spawn.begin(program, null, null, group=group, scheduler=scheduler)

    begun = time.perf_counter()
    steps = confinement.start(("true", number), limits, start)
    attempt = next(steps)
    while not attempt.read():
        pass
    attempt.close()
    pid = attempt.pid
    started = time.perf_counter()
    os.waitpid(pid, 0)
    os.close(null)
    ended = time.perf_counter()
    confinement.groups.remove(("true", number), 0.0)
    removed = time.perf_counter()
    while confinement.groups.deadline() is not None:
        time.sleep(0.001)
        confinement.groups.look(time.monotonic() + 1.0)
    return (started - begun) * 1e3, (removed - ended) * 1e3


if __name__ == "__main__":
    sys.exit(run("start_cost", main))
