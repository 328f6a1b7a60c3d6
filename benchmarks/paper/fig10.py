"""Fig. 10: processes grow to the limit of their slave, and migrate to the one with most room."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any, Final

from benchmarks.machine import say
from benchmarks.paper import pictures
from benchmarks.paper.judging import wrong_move
from benchmarks.paper.labs import LabCluster
from benchmarks.paper.report import Options, Result
from benchmarks.paper.settings import HOLDER_MB, MEMORY_LIMIT, alike, cluster_settings, holder
from benchmarks.paper.trace import Move, Trace
from rosrm_lab import MIB, HostPlan, uniform

#: Numbers of one run of which the median and the range over several runs are reported.
SPREAD: Final = ("moves", "longest_move_s")
CLAIM: Final = (
    "A process whose slave has reached the limit of 80 % migrates to the one of the equal slaves "
    "that has the largest margin"
)
_SLAVES, _MEMORY = 3, 512 * MIB
#: Seconds at which the processes are submitted, and at which the run ends.
_COME: Final = (0.0, 33.0, 75.0)
_END: Final = 135.0
#: MB of each at its beginning, and MB that it grows by in every second.
_MB, _GROWTH = 20.0, 5.5
_NEED: Final = (_MB + HOLDER_MB) * 1e6
_LEAST_MOVES: Final = 2
#: The default of `cluster.yaml`, set here because the judgement depends on it.
_HEADROOM: Final = 0.05
#: How many times as fast as the paper's run this one is.
_THAN_PAPER: Final = 2.7
#: How many times as fast as usual a small run is.
_FASTER: Final = 3.0


def measure(options: Options) -> Result:
    """Let three processes grow, one after the other."""
    faster = _FASTER if options.small else 1.0
    plans = uniform(_SLAVES, memory=_MEMORY, cpu=0.5, disk=64 * MIB)
    # As in the paper, what counts at the destination is the size at which a process begins there.
    migration = {"need": "declared", "headroom": _HEADROOM, "cooldown": f"{30 / faster:g}s"}
    settings = cluster_settings(migration={**migration, "hysteresis": f"{2 / faster:g}s"})
    with LabCluster(f"{options.lab}-fig10", plans, options.folder, settings) as cluster:
        for plan in plans:
            cluster.start_slave(plan.name)
        cluster.wait_for_slaves([plan.name for plan in plans])
        say("fig10: three slaves are up; three growing processes come")
        cluster.begin()
        coming = [
            (at / faster, partial(cluster.submit, _growing(number, _GROWTH * faster)))
            for number, at in enumerate(_COME, start=1)
        ]
        last = cluster.play(coming, _END / faster)
        trace = cluster.trace
    wrong, figures = judge(trace)
    lost = [name for name, state in last.states.items() if state not in ("running", "migrating")]
    wrong += [f"{name} is {last.states[name]} at the end" for name in lost]
    return Result(
        wrong,
        figures,
        scaled(plans, faster),
        partial(_draw, trace, trace.moves()),
        source=cluster.records,
    )


def _growing(number: int, growth: float) -> dict[str, Any]:
    entry = holder(f"process_{number}", _MB, migration="relaunch")
    entry["arguments"] = ["--mb", f"{_MB:g}", "--grow", f"{growth:g}"]
    return entry


def judge(trace: Trace) -> tuple[list[str], dict[str, Any]]:
    """Return the objections to the claim, and the numbers."""
    moves = trace.moves()
    wrong = []
    if len(moves) < _LEAST_MOVES:
        wrong.append(f"{len(moves)} migrations; at least {_LEAST_MOVES} were expected")
    for move in moves:
        look = trace.before(move.begun)
        if look is not None:
            wrong.append(wrong_move(look, move, _NEED, MEMORY_LIMIT, _HEADROOM))
    wrong += [f"{event.process} stayed: {event.message}" for event in trace.of_kind("stayed")]
    return [one for one in wrong if one], {
        "moves": len(moves),
        "longest_move_s": round(max((move.ended - move.begun for move in moves), default=0.0), 3),
        "migrations": [_plain(move, trace) for move in moves],
        "limit_reached_s": [
            {"s": round(event.elapsed - trace.start, 2), "host": event.host}
            for event in trace.of_kind("over_limit")
        ],
        **trace.curves(),
    }


def _plain(move: Move, trace: Trace) -> dict[str, Any]:
    return {
        "s": round(move.begun - trace.start, 2),
        "took_s": round(move.ended - move.begun, 3),
        "process": move.process,
        "from": move.source,
        "to": move.destination,
        "process_mb": round(move.size / 1e6, 1),
    }


def _draw(trace: Trace, moves: list[Move], path: Path) -> None:
    pictures.usage(path, trace, MEMORY_LIMIT, moves=moves, mark_assignments=False)


def scaled(plans: Sequence[HostPlan], faster: float = 1.0) -> dict[str, str]:
    """Return the differences from the paper, for a run that is `faster` times as fast as usual."""
    coming = ", ".join(f"{at / faster:g}" for at in _COME)
    return {
        "time": f"{_THAN_PAPER * faster:.1f} times as fast as in the paper: processes grow by "
        f"{_GROWTH * faster:g} MB a second, and come at {coming} s",
        "hosts": f"{alike(plans)}; the paper: three of 16 GB",
    }
