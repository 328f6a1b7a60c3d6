"""Fig. 9: the master's processing time for one cycle against the number of slaves.

One cycle is one reading received and decoded for each slave, and one decision. Through real rclpy,
up to 1,000 slaves: the CPU time of all threads of a real master, per cycle of the slaves, and the
core's time for one decision among so many hosts. In the core alone, up to 10,000: taking in one
reading of each, and one decision.
"""

from __future__ import annotations

import tempfile
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Any, Final

from benchmarks.decide import decision
from benchmarks.machine import say
from benchmarks.paper import pictures
from benchmarks.paper.judging import Line, line
from benchmarks.paper.report import Options, Result
from benchmarks.paper.settings import FIG9_INTERCEPT_MS, FIG9_SLOPE_MS, RATE_HZ
from benchmarks.scale import Crowd, Loads, readings
from rosrm.local_cluster import LocalCluster

CLAIM: Final = (
    "The master's time for one cycle grows at most linearly with the slaves, by less for each than "
    "in the paper, and stays below the 100 ms of a cycle with 1,000 slaves"
)
_PAPER: Final = Line(FIG9_SLOPE_MS, FIG9_INTERCEPT_MS, 1.0)
_REAL: Final = (1, 10, 25, 50, 100, 200, 400, 700, 1000)
_CORE: Final = (1, 10, 100, 1000, 3000, 10_000)
_FEW: Final = (1, 100, 300)
#: Processes, and so DDS participants, that the simulated slaves share.
_SHARED_BY: Final = 2
#: So far a usage goes in a cycle that each reading is sent at once.
_STEP: Final = 0.1
_WARM_UP, _SECONDS = 3.0, 6.0
_REGISTER: Final = 240.0
#: Part of the variance that the line must explain to describe the points at all. With few slaves
#: each reading wakes the master, with many it takes several at a time: so they bend downwards.
_LEAST_R2: Final = 0.9
_CYCLE_MS: Final = 100.0
#: Decisions, of which the median counts.
_DECISIONS: Final = 60


def measure(options: Options) -> Result:
    """Measure all numbers of slaves."""
    real = [_through_rclpy(slaves) for slaves in (_FEW if options.small else _REAL)]
    core = [_in_core(slaves) for slaves in (_FEW if options.small else _CORE)]
    fit = line([one["slaves"] for one in real], [one["ms"] for one in real])
    wrong, figures = judge(real, core, fit)
    return Result(wrong, figures, _SCALED, partial(_draw, real, core, fit))


def _through_rclpy(slaves: int) -> dict[str, Any]:
    """One cycle of a real master with so many simulated slaves."""
    processes = min(slaves, _SHARED_BY)
    with tempfile.TemporaryDirectory(prefix="rosrm-fig9-") as folder, ExitStack() as opened:
        cluster = LocalCluster(Path(folder))
        opened.callback(cluster.close)
        assert cluster.domain is not None
        cluster.start_master()
        cluster.client.list()
        loads = Loads(cluster.ros)
        opened.callback(loads.close)
        crowd = Crowd(cluster.domain, RATE_HZ, _STEP, _REGISTER)
        opened.callback(crowd.close)
        crowd.start(slaves, processes)
        loads.wait(_WARM_UP)
        seen = readings(crowd, loads, _SECONDS)
    decided, _ = decision(slaves, _DECISIONS // 20)
    received = seen["us_per_message"] * slaves / 1e3
    ms = received + decided * slaves / 1e3
    say(f"fig9: {slaves} slaves: {ms:.3f} ms a cycle, {seen['missed']:.0f} readings missed")
    return {
        "slaves": slaves,
        "ms": round(ms, 4),
        "decision_ms": round(decided * slaves / 1e3, 4),
        "messages_per_cycle": round(seen["messages_per_cycle"], 3),
        "received_per_s": round(seen["received_per_s"], 1),
        "missed": seen["missed"],
        "master_cpu": round(seen["master_cpu"], 4),
        "processes": processes,
        "participants": processes,
    }


def _in_core(slaves: int) -> dict[str, Any]:
    decided, taken_in = decision(slaves, _DECISIONS // 20)
    ms = (decided + taken_in) * slaves / 1e3
    say(f"fig9: {slaves} hosts in the core: {ms:.4f} ms a cycle")
    return {"slaves": slaves, "ms": round(ms, 5)}


def judge(
    real: list[dict[str, Any]], core: list[dict[str, Any]], fit: Line
) -> tuple[list[str], dict[str, Any]]:
    """What speaks against the claim, and the numbers."""
    wrong = []
    if fit.r2 < _LEAST_R2:
        wrong.append(
            f"the line does not describe the points: R2 is {fit.r2:.4f}, less than {_LEAST_R2}"
        )
    if not 0.0 < fit.slope < _PAPER.slope:
        wrong.append(
            f"a slave costs {1e3 * fit.slope:.1f} us a cycle; the paper: {1e3 * _PAPER.slope:.1f}"
        )
    wrong += [
        f"{one['slaves']} slaves take {one['ms']:.1f} ms of a cycle of {_CYCLE_MS:g} ms"
        for one in (*real, *core)
        if one["ms"] >= _CYCLE_MS
    ]
    return wrong, {
        "slope_us": round(1e3 * fit.slope, 3),
        "intercept_us": round(1e3 * fit.intercept, 1),
        "r2": round(fit.r2, 5),
        "paper_slope_us": round(1e3 * _PAPER.slope, 3),
        "paper_intercept_us": round(1e3 * _PAPER.intercept, 3),
        "real": real,
        "core": core,
    }


def _draw(real: list[dict[str, Any]], core: list[dict[str, Any]], fit: Line, path: Path) -> None:
    points = [
        ([one["slaves"] for one in many], [one["ms"] for one in many]) for many in (real, core)
    ]
    pictures.cycle_times(path, points[0], points[1], fit, _PAPER)


_SCALED: Final = {
    "slaves": "simulated: real slave endpoints and cores, whose readings are a random walk and go "
    f"out in every cycle; they share {_SHARED_BY} processes with one DDS participant each, and "
    "each has a publisher and a client of its own",
    "time": "CPU time of the whole master process instead of the duration of its loop; the "
    "decision is timed in the core",
}
