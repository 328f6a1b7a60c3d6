"""Fig. 9: the master's processing time for one cycle against the number of slaves.

One cycle is one reading received and decoded for each slave, and one decision. Through real rclpy,
up to 1,000 slaves: the CPU time of all threads of a real master, per cycle of the slaves, and the
core's time for one decision among so many hosts (`benchmarks.scale`, in a process of its own,
because it changes its network). In the core alone, up to 10,000 slaves: one reading of each, and
one decision.
"""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from functools import partial
from pathlib import Path
from typing import Any, Final

from benchmarks.decide import decision
from benchmarks.machine import say
from benchmarks.paper import pictures
from benchmarks.paper.judging import Line, line
from benchmarks.paper.labs import ROOT, Failed
from benchmarks.paper.report import Options, Result
from benchmarks.paper.settings import FIG9_INTERCEPT_MS, FIG9_SLOPE_MS, RATE_HZ

#: Numbers of one run of which the median and the range over several runs are reported.
SPREAD: Final = ("slope_us", "intercept_us")
CLAIM: Final = (
    "The master's time for one cycle grows at most linearly with the slaves, by less for each than "
    "in the paper, and stays below the 100 ms of a cycle with 1,000 slaves"
)
_PAPER: Final = Line(FIG9_SLOPE_MS, FIG9_INTERCEPT_MS, 1.0)
_REAL: Final = (1, 10, 50, 100, 200, 400, 700, 1000)
_CORE: Final = (1, 10, 100, 1000, 3000, 10_000)
_FEW: Final = (1, 100, 300)
#: Processes, and so DDS participants, that the simulated slaves share.
_SHARED_BY: Final = 2
#: Change of a usage in a cycle; so large that each reading is sent at once.
_STEP: Final = 0.1
#: Seconds at the full rate before the count (because slaves request work repeatedly in the first
#: half minute), the same for a small run, and seconds of the count.
_SETTLE, _SHORTLY, _SECONDS = 30.0, 3.0, 6.0
#: Seconds after which the measurement of one number of slaves is given up, and for its end then.
_LONGEST, _END = 400.0, 60.0
#: Fractions of the readings that the master may miss, and of the rate that may be lacking.
_MOST_MISSED, _MOST_WANTING = 0.01, 0.1
#: Part of the variance that the line must explain to describe the points at all. The points bend
#: downwards: with few slaves each reading wakes the master, with many it receives several at once.
_LEAST_R2: Final = 0.9
_CYCLE_MS: Final = 100.0
#: Number of decisions; the median counts.
_DECISIONS: Final = 60


def measure(options: Options) -> Result:
    """Measure all numbers of slaves."""
    settle = _SHORTLY if options.small else _SETTLE
    slaves = _FEW if options.small else _REAL
    real = [through_rclpy(one, settle, options.folder) for one in slaves]
    core = [_in_core(slaves) for slaves in (_FEW if options.small else _CORE)]
    fit = line([one["slaves"] for one in real], [one["ms"] for one in real])
    wrong, figures = judge(real, core, fit)
    return Result(wrong, figures, _SCALED, partial(_draw, real, core, fit))


def through_rclpy(slaves: int, settle: float, folder: Path) -> dict[str, Any]:
    """Measure one cycle of a real master with so many simulated slaves.

    Args:
        slaves: how many.
        settle: seconds at the full rate before the count.
        folder: for the log of the measurement.
    """
    processes = min(slaves, _SHARED_BY)
    options = {
        "slaves": slaves, "hz": RATE_HZ, "seconds": _SECONDS, "step": _STEP, "settle": settle,
        "processes": processes,
    }  # fmt: skip
    seen = _scale([f"--{name}={value:g}" for name, value in options.items()], folder)
    decided_ms = decision(slaves, _DECISIONS).decision / 1e3
    # An unchanged reading is not sent. If it were, one message a slave would cost so much more.
    received = seen["us_per_message"] * slaves / 1e3 / seen["messages_per_cycle"]
    ms = received + decided_ms
    say(f"fig9: {slaves} slaves: {ms:.3f} ms a cycle, {seen['missed']} readings missed")
    return {
        "slaves": slaves,
        "ms": round(ms, 4),
        "decision_ms": round(decided_ms, 4),
        "us_per_message": round(seen["us_per_message"], 3),
        "messages_per_cycle": round(seen["messages_per_cycle"], 3),
        "offered_per_s": round(seen["offered_per_s"], 1),
        "received_per_s": round(seen["received_per_s"], 1),
        "cycles": round(seen["received_per_s"] * seen["seconds"]) + seen["missed"],
        "missed": seen["missed"],
        "late_cycles": seen["late_cycles"],
        "masters_lost": seen["masters_lost"],
        "hosts_heard": seen["hosts_heard"],
        "master_cpu": round(seen["master_cpu"], 4),
        "oldest_reading_p99_s": round(seen["oldest_reading_p99_s"], 4),
        "request_process_p50_ms": round(seen["request_process_p50_ms"], 2),
        "processes": processes,
        "participants": processes,
        "transports": seen["transports"],
    }


def _scale(options: list[str], folder: Path) -> dict[str, Any]:
    """Run `benchmarks.scale`; return its figures."""
    log = folder / "scale.log"
    with log.open("w") as sink:
        process = subprocess.Popen(
            [sys.executable, "-m", "benchmarks.scale", *options],
            stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=sink, text=True, cwd=ROOT,
            start_new_session=True,  # a Ctrl-C is for the parent, which ends it
        )  # fmt: skip
        try:
            said, _ = process.communicate(timeout=_LONGEST)
        except BaseException:  # also a Ctrl-C, which does not reach a session of its own
            _end(process)
            raise
    if process.returncode:
        words = "\n  ".join(log.read_text(errors="replace").strip().splitlines()[-5:])
        raise Failed(
            f"python -m benchmarks.scale {' '.join(options)} ended with exit code "
            f"{process.returncode}:\n  {words}"
        )
    report: dict[str, Any] = json.loads(said.splitlines()[-1])
    return report


def _end(process: subprocess.Popen[str]) -> None:
    """Let the measurement end its master and slaves."""
    process.send_signal(signal.SIGTERM)
    try:
        process.communicate(timeout=_END)
    except subprocess.TimeoutExpired:
        process.kill()
        process.communicate()


def _in_core(slaves: int) -> dict[str, Any]:
    timed = decision(slaves, _DECISIONS)
    ms = (timed.decision + timed.readings) / 1e3
    say(f"fig9: {slaves} hosts in the core: {ms:.4f} ms a cycle")
    return {"slaves": slaves, "ms": round(ms, 5)}


def judge(
    real: list[dict[str, Any]], core: list[dict[str, Any]], fit: Line
) -> tuple[list[str], dict[str, Any]]:
    """Return the objections to the claim, and the numbers."""
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
    wrong += [reason for one in real for reason in not_kept_up(one)]
    return wrong, {
        "slope_us": round(1e3 * fit.slope, 3),
        "intercept_us": round(1e3 * fit.intercept, 1),
        "r2": round(fit.r2, 5),
        "paper_slope_us": round(1e3 * _PAPER.slope, 3),
        "paper_intercept_us": round(1e3 * _PAPER.intercept, 3),
        "real": real,
        "core": core,
    }


def not_kept_up(one: dict[str, Any]) -> list[str]:
    """Return the deviations from the intended rates, as sentences."""
    slaves, intended = one["slaves"], one["slaves"] * RATE_HZ
    wrong = []
    if one["missed"] > _MOST_MISSED * one["cycles"]:
        wrong.append(f"of {slaves} slaves {one['missed']} of {one['cycles']} readings were missed")
    wrong += [
        f"{slaves} slaves: {one[rate]:.1f} cycles a second instead of {intended:g} were {what}"
        for rate, what in (("offered_per_s", "carried out"), ("received_per_s", "received"))
        if one[rate] < (1 - _MOST_WANTING) * intended
    ]
    if one["hosts_heard"] != slaves:
        wrong.append(f"of {slaves} slaves {one['hosts_heard']} sent readings")
    if one["masters_lost"]:
        wrong.append(f"of {slaves} slaves {one['masters_lost']} took the master for lost")
    return wrong


def _draw(real: list[dict[str, Any]], core: list[dict[str, Any]], fit: Line, path: Path) -> None:
    points = [
        ([one["slaves"] for one in many], [one["ms"] for one in many]) for many in (real, core)
    ]
    pictures.cycle_times(path, points[0], points[1], fit, _PAPER)


_SCALED: Final = {
    "slaves": "simulated: real slave endpoints and cores, whose readings are a random walk; nearly "
    "all go out (messages_per_cycle), and what is left out is reckoned in; they share "
    f"{_SHARED_BY} processes with one DDS participant each, and each has a publisher and a client "
    "of its own",
    "time": "CPU time of the whole master process instead of the duration of its loop; the "
    "decision is timed in the core",
}
