"""Fig. 6: three slaves are filled with processes of 8 to 80 MB up to 80 %, and stay balanced."""

from __future__ import annotations

import random
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any, Final

from benchmarks.machine import say
from benchmarks.paper import pictures
from benchmarks.paper.judging import NOISE, not_to_emptiest, over, room_left, widest_gap
from benchmarks.paper.labs import LabCluster
from benchmarks.paper.report import Options, Result
from benchmarks.paper.settings import HOLDER_MB, MEMORY_LIMIT, alike, holder
from benchmarks.paper.simulated import agreement
from benchmarks.paper.trace import Trace, per_host
from rosrm_lab import GIB, MIB, HostPlan, uniform

#: Numbers of one run of which the median and the range over several runs are reported.
SPREAD: Final = ("processes", "widest_gap_points")
CLAIM: Final = (
    "Processes go to the slave with the largest margin: the three stay balanced all the way, and "
    "processes are allocated until each has reached its limit of 80 %"
)
_LEAST_MB, _MOST_MB = 8, 80
_SEED: Final = 6
#: The processes need more than the hosts have, by this factor, so that the queue has to wait.
_TOO_MUCH: Final = 1.2
#: Seconds between two submissions, and after the last one.
_EVERY: Final = 0.8
_AFTER: Final = 6.0


def hosts(*, small: bool) -> list[HostPlan]:
    """Return three equal hosts."""
    return uniform(3, memory=256 * MIB if small else GIB, cpu=0.5, disk=64 * MIB)


def sizes(memory: float, seed: int = _SEED) -> list[int]:
    """Return the MB of each process, in sum more than three hosts of so many bytes can hold."""
    chance = random.Random(seed)  # noqa: S311 - sizes, no secrets
    room_mb = _TOO_MUCH * 3 * MEMORY_LIMIT * memory / 1e6
    chosen: list[int] = []
    while sum(chosen) + HOLDER_MB * len(chosen) < room_mb:
        chosen.append(chance.randint(_LEAST_MB, _MOST_MB))
    return chosen


def measure(options: Options) -> Result:
    """Fill three hosts."""
    plans = hosts(small=options.small)
    chosen = sizes(plans[0].memory or GIB)
    with LabCluster(f"{options.lab}-fig6", plans, options.folder) as cluster:
        for plan in plans:
            cluster.start_slave(plan.name)
        cluster.wait_for_slaves([plan.name for plan in plans])
        say(f"fig6: three slaves are up; {len(chosen)} processes of 8 to 80 MB come")
        cluster.begin()
        entries = [holder(name, mb) for name, mb in named(chosen).items()]
        cluster.feed(entries, every=_EVERY, after=_AFTER)
        cluster.stop_master()
        trace = cluster.trace
    needs = {name: (mb + HOLDER_MB) * 1e6 for name, mb in named(chosen).items()}
    wrong, figures = judge(trace, needs)
    figures["simulation"] = simulation = agreement(cluster.records)
    wrong += replayed_otherwise(simulation)
    scaled = {"hosts": f"{alike(plans)}; the paper: three of 16 GB", **_SCALED}
    return Result(wrong, figures, scaled, partial(_draw, trace), source=cluster.records)


def replayed_otherwise(simulation: Mapping[str, Any]) -> list[str]:
    """Return an objection where a replay of the run's record decides otherwise."""
    differently, decisions = simulation["replayed_differently"], simulation["replayed_decisions"]
    if not differently and decisions:
        return []
    return [f"`rosrm simulate` decides {differently} of the record's {decisions} differently"]


def named(chosen: list[int]) -> dict[str, int]:
    """Return the processes' MB by name, in the order of submission."""
    return {f"process_{number:03d}": mb for number, mb in enumerate(chosen)}


def judge(trace: Trace, needs: dict[str, float]) -> tuple[list[str], dict[str, Any]]:
    """Return the objections to the claim, and the numbers.

    Args:
        trace: of the run.
        needs: bytes by process, in the order of the queue.
    """
    assigned = trace.placed()
    last = trace.looks[-1]
    largest = max(needs.values()) / min(host.capacity for host in last.hosts.values())
    apart = widest_gap(trace, trace.hosts)
    wrong = not_to_emptiest(trace, needs)
    if apart > largest + NOISE:
        wrong.append(
            f"slaves were apart by {100 * apart:.1f} points, more than the largest process "
            f"({100 * largest:.1f})"
        )
    wrong += [
        f"{name} reached {100 * peak:.1f} %" for name, peak in over(trace, MEMORY_LIMIT).items()
    ]
    waiting = [name for name in needs if last.states.get(name) == "queued"]
    if not waiting:
        wrong.append("nothing waits at the end: the slaves did not reach their limits")
    elif room := room_left(last, needs[waiting[0]], MEMORY_LIMIT):
        wrong.append(f"{waiting[0]} waits, and {', '.join(room)} has room for it")
    ends = {name: one[-1] for name, one in trace.curves()["memory_percent"].items()}
    return wrong, {
        "processes": len(assigned),
        "per_host": per_host(assigned),
        "waiting_at_the_end": len(waiting),
        "widest_gap_points": round(100 * apart, 2),
        "largest_process_points": round(100 * largest, 2),
        "memory_percent_at_the_end": ends,
        **trace.curves(),
    }


def _draw(trace: Trace, path: Path) -> None:
    pictures.usage(path, trace, MEMORY_LIMIT)


_SCALED: Final = {
    "master": "on a host of its own; in the paper one host is both master and slave",
    "processes": f"plain processes, one submitted every {_EVERY:g} s (each when the one before is "
    "in the readings), that say beforehand what they need",
}
