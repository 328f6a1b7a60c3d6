"""Fig. 8: the number of processes that fit grows in proportion to the slaves, 1 to 10."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any, Final

from benchmarks.machine import say
from benchmarks.paper import pictures
from benchmarks.paper.judging import Line, line, over, peak, proportion
from benchmarks.paper.labs import LabCluster
from benchmarks.paper.report import Options, Result
from benchmarks.paper.settings import HOLDER_MB, MEMORY_LIMIT, alike, holder
from benchmarks.paper.trace import Look, Trace, per_host
from rosrm_lab import MIB, uniform

#: Numbers of one run of which the median and the range over several runs are reported.
SPREAD: Final = ("slope", "r2", "highest_percent")
CLAIM: Final = (
    "The number of processes that are allocated is proportional to that of slaves; none ends above "
    "its limit of 80 % by more than the noise of a reading"
)
_MB: Final = 40
_NEED: Final = (_MB + HOLDER_MB) * 1e6
_LEAST_R2: Final = 0.999
_SLAVES, _FEW = 10, 3
_MEMORY, _LITTLE = 528 * MIB, 192 * MIB
#: Seconds without an assignment after which no more fits: the readings include all processes.
_QUIET: Final = 4.0
_LONGEST: Final = 90.0


def measure(options: Options) -> Result:
    """Add one slave after the other to a queue that never becomes empty."""
    slaves, memory = (_FEW, _LITTLE) if options.small else (_SLAVES, _MEMORY)
    plans = uniform(slaves, memory=memory, cpu=0.5, disk=64 * MIB)
    most = int(slaves * MEMORY_LIMIT * memory / _NEED) + slaves
    held: list[int] = []
    with LabCluster(f"{options.lab}-fig8", plans, options.folder) as cluster:
        cluster.submit(*(holder(f"process_{number:03d}", _MB) for number in range(most)))
        cluster.begin()
        for plan in plans:
            cluster.start_slave(plan.name)
            look = cluster.wait_until(
                f"{plan.name} filled", partial(_settled, cluster.trace, plan.name), _LONGEST
            )
            held.append(look.count("running"))
            say(f"fig8: {len(held)} slaves hold {held[-1]} processes")
        trace = cluster.trace
    numbers = list(range(1, slaves + 1))
    fit = line(numbers, held)
    wrong, figures = judge(trace, held, fit)
    scaled = {"hosts": f"{alike(plans)}; the paper: ten of 4 GB", **_SCALED}
    return Result(
        wrong, figures, scaled, partial(_draw, numbers, held, fit), source=cluster.records
    )


def _settled(trace: Trace, newest: str, look: Look) -> bool:
    """Return True if the newest host holds a process, and no assignment was made for a while."""
    assigned = list(trace.of_kind("assigned"))
    if not any(event.host == newest for event in assigned):
        return False
    waiting = look.count("running") + look.count("queued") < len(look.states)
    return not waiting and look.elapsed - assigned[-1].elapsed >= _QUIET


def judge(trace: Trace, held: list[int], fit: Line) -> tuple[list[str], dict[str, Any]]:
    """Return the objections to the claim, and the numbers.

    Args:
        trace: of the run.
        held: processes by number of slaves, from 1 on.
        fit: through them.
    """
    wrong = []
    if fit.r2 < _LEAST_R2:
        wrong.append(f"R2 is {fit.r2:.5f}, less than {_LEAST_R2}")
    if fit.slope <= 0:
        wrong.append("more slaves do not hold more processes")
    if not trace.looks[-1].count("queued"):
        wrong.append("the queue became empty: more could have been held")
    through_origin = proportion(range(1, len(held) + 1), held)
    if through_origin.r2 < _LEAST_R2:
        wrong.append(
            f"not in proportion: R2 of the line through the origin is {through_origin.r2:.5f}, "
            f"less than {_LEAST_R2}"
        )
    beyond = over(trace, MEMORY_LIMIT)
    wrong += [f"{name} reached {100 * top:.1f} %" for name, top in beyond.items()]
    return wrong, {
        "r2": round(fit.r2, 6),
        "r2_through_origin": round(through_origin.r2, 6),
        "slope": round(fit.slope, 4),
        "intercept": round(fit.intercept, 4),
        "slaves": list(range(1, len(held) + 1)),
        "processes": held,
        "highest_percent": round(100 * peak(trace), 1),
        "over_limit_percent": {name: round(100 * top, 1) for name, top in beyond.items()},
        "per_host": per_host(trace.placed()),
        **trace.curves(),
    }


def _draw(slaves: list[int], held: list[int], fit: Line, path: Path) -> None:
    pictures.processes(path, slaves, held, fit)


_SCALED: Final = {
    "processes": f"plain processes of {_MB} MB, not ROS nodes: a node is 64 MiB by itself, and "
    "from about 130 participants on one machine they no longer find each other",
    "order": "the slaves join one after the other, each when the ones before are full",
}
