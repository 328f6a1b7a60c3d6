"""Fig. 7: slaves join at 25 s and 75 s, and get all work until they are as full as the rest."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any, Final

from benchmarks.machine import say
from benchmarks.paper import pictures
from benchmarks.paper.judging import NOISE, not_to_emptiest, over, room_left, widest_gap
from benchmarks.paper.labs import LabCluster
from benchmarks.paper.report import Options, Result
from benchmarks.paper.settings import HOLDER_MB, MEMORY_LIMIT, alike, holder
from benchmarks.paper.trace import Trace, per_host
from rosrm_lab import GIB, MIB, uniform

#: Numbers of one run of which the median and the range over several runs are reported.
SPREAD: Final = ("gap_at_the_end_points",)
CLAIM: Final = (
    "Slaves that join at 25 s and 75 s are given the processes, as they have the largest margin, "
    "until all are equally full"
)
_MB: Final = 32
#: Seconds at which slaves 2 and 3 are started.
JOINS: Final = (25.0, 75.0)
#: Seconds within which a slave that was started must have got a process: it has to start, too.
_TAKEN_UP: Final = 15.0
_NEED: Final = (_MB + HOLDER_MB) * 1e6
#: Seconds between two submissions, and after the last one.
_EVERY: Final = 1.8
_AFTER: Final = 6.0


def measure(options: Options) -> Result:
    """Fill hosts that join one after the other."""
    faster = 4.0 if options.small else 1.0
    plans = uniform(3, memory=256 * MIB if options.small else GIB, cpu=0.5, disk=64 * MIB)
    count = int(1.1 * 3 * MEMORY_LIMIT * (plans[0].memory or GIB) / _NEED)
    joins = [at / faster for at in JOINS]
    with LabCluster(f"{options.lab}-fig7", plans, options.folder) as cluster:
        cluster.start_slave("host1")
        cluster.wait_for_slaves(["host1"])
        say(f"fig7: slave 1 is up, the others follow; {count} processes of {_MB} MB come")
        cluster.begin()
        entries = [holder(f"process_{number:03d}", _MB) for number in range(count)]
        slaves = [
            (at, partial(cluster.start_slave, plan.name))
            for at, plan in zip(joins, plans[1:], strict=True)
        ]
        cluster.feed(entries, every=_EVERY, after=_AFTER, also=slaves)
        trace = cluster.trace
    wrong, figures = judge(trace, joins)
    scaled = {
        "hosts": f"{alike(plans)}; the paper: three of 16 GB",
        "processes": f"plain processes of {_MB} MB, one submitted every {_EVERY:g} s",
        "joins": f"at {' and '.join(f'{at:g}' for at in joins)} s",
    }
    return Result(wrong, figures, scaled, partial(_draw, trace, joins), source=cluster.records)


def judge(trace: Trace, joins: Sequence[float]) -> tuple[list[str], dict[str, Any]]:
    """Return the objections to the claim, and the numbers.

    Args:
        trace: of the run.
        joins: seconds at which the second and third slave were started.
    """
    assigned = trace.placed()
    wrong = not_to_emptiest(trace, {event.process: _NEED for event in assigned})
    first: dict[str, float] = {}
    for event in assigned:
        first.setdefault(event.host, event.elapsed - trace.start)
    for host, at in zip(trace.hosts[1:], joins, strict=False):
        if not at <= first.get(host, float("inf")) <= at + _TAKEN_UP:
            wrong.append(f"{host}, started at {at:g} s, got its first process at {first.get(host)}")
    if len(trace.hosts) != 1 + len(joins):
        wrong.append(f"of {1 + len(joins)} slaves, {len(trace.hosts)} were there")
    last = trace.looks[-1]
    one = _NEED / min(host.capacity for host in last.hosts.values())
    apart = widest_gap(trace, trace.hosts, last.elapsed - _AFTER / 2)
    if apart > one + NOISE:
        wrong.append(f"at the end the slaves are apart by {100 * apart:.1f} points")
    wrong += [
        f"{name} reached {100 * top:.1f} %" for name, top in over(trace, MEMORY_LIMIT).items()
    ]
    if room := room_left(last, _NEED, MEMORY_LIMIT):
        wrong.append(f"{', '.join(room)} could have taken one more process")
    return wrong, {
        "processes": len(assigned),
        "per_host": per_host(assigned),
        "joins_s": list(joins),
        "first_process_s": {name: round(at, 2) for name, at in first.items()},
        "gap_at_the_end_points": round(100 * apart, 2),
        "one_process_points": round(100 * one, 2),
        **trace.curves(),
    }


def _draw(trace: Trace, joins: Sequence[float], path: Path) -> None:
    pictures.usage(path, trace, MEMORY_LIMIT, joins=joins)
