"""Pictures of the figures with the axes and units of the paper."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import matplotlib as mpl
import numpy as np

from benchmarks.paper.judging import Line
from benchmarks.paper.trace import Move, Trace

mpl.use("Agg")
from matplotlib import pyplot as plt  # after the backend is chosen
from matplotlib.axes import Axes
from matplotlib.figure import Figure

_INK: Final = "#22303c"
_FAINT: Final = "#dddad2"
_COLOURS: Final = ("#00798c", "#d1495b", "#c98a1b", "#5b6c9d")

#: Text on a line of the picture.
_WORDS: Final[dict[str, Any]] = {
    "ha": "center", "va": "center", "fontsize": 8, "color": _INK,
    "bbox": {"fc": "white", "ec": "none", "pad": 1},
}  # fmt: skip


def usage(
    path: Path, trace: Trace, limit: float, *, joins: Sequence[float] = (),
    moves: Sequence[Move] = (), mark_assignments: bool = True,
) -> None:  # fmt: skip
    """Draw figs. 6, 7 and 10: memory utilisation rate of each slave over the elapsed time.

    Args:
        path: of the .png.
        trace: of the run.
        limit: fraction.
        joins: seconds at which slaves were started.
        moves: migrations to be marked.
        mark_assignments: draw a tick below the curves for each.
    """
    figure, axes = _axes("Elapsed time [s]", "Memory utilization rate [%]")
    colours = dict(zip(trace.hosts, _COLOURS, strict=False))
    for number, host in enumerate(trace.hosts, start=1):
        seen = np.array([np.nan if one is None else one for one in trace.percent(host)])
        axes.plot(trace.times(), seen, color=colours[host], lw=1.7, label=f"slave {number}")
    axes.axhline(100 * limit, color=_INK, lw=1.0, ls=(0, (6, 4)), label=f"limit {100 * limit:g} %")
    for at in joins:
        axes.axvline(at, color=_INK, lw=0.8, ls=":")
        axes.annotate("slave added", (at, 96), **_WORDS)
    if mark_assignments:
        for row, host in enumerate(trace.hosts):
            times = [one["s"] for one in trace.assignments() if one["host"] == host]
            axes.plot(times, [2 + 2.5 * row] * len(times), ls="", marker="|", ms=6,
                      color=colours[host])  # fmt: skip
    _mark_moves(axes, trace, moves)
    axes.set_ylim(0, 100)
    axes.set_xlim(0, max(trace.times()))
    _save(figure, axes, path)


def _mark_moves(axes: Axes, trace: Trace, moves: Sequence[Move]) -> None:
    number = {host: index for index, host in enumerate(trace.hosts, start=1)}
    for move in moves:
        at = move.begun - trace.start
        axes.axvline(at, color=_INK, lw=0.8, ls=":")
        way = f"{number[move.source]} to {number[move.destination]}"
        axes.annotate(f"{move.process.replace('_', ' ')}:\n{way}", (at, 94), **_WORDS)


def processes(path: Path, slaves: Sequence[int], held: Sequence[int], fit: Line) -> None:
    """Draw fig. 8: processes that can be allocated against the number of slaves."""
    figure, axes = _axes("Number of slaves", "Number of processes")
    axes.plot(slaves, held, ls="", marker="o", color=_COLOURS[0], label="measured")
    words = f"y = {fit.slope:.2f}x {fit.intercept:+.2f}, R² = {fit.r2:.4f}"
    axes.plot(slaves, [fit.slope * x + fit.intercept for x in slaves], color=_COLOURS[1], lw=1.2,
              label=words)  # fmt: skip
    axes.set_xlim(0, max(slaves) + 0.5)
    axes.set_ylim(0, None)
    _save(figure, axes, path)


def cycle_times(
    path: Path, real: tuple[Sequence[int], Sequence[float]],
    core: tuple[Sequence[int], Sequence[float]], fit: Line, paper: Line,
) -> None:  # fmt: skip
    """Draw fig. 9: processing time of the master's cycle against the number of slaves.

    Args:
        path: of the .png.
        real: slaves and milliseconds, through rclpy.
        core: the same in the core alone.
        fit: through the real ones.
        paper: the paper's own line.
    """
    figure, (near, far) = plt.subplots(1, 2, figsize=(11, 4.4), layout="constrained")
    for axes in (near, far):
        _dress(axes, "Number of slaves", "Processing time [ms]")
    xs = np.array([0, max(real[0])])
    near.plot(*real, ls="", marker="o", color=_COLOURS[0], label="master, through rclpy")
    near.plot(xs, fit.slope * xs + fit.intercept, color=_COLOURS[0], lw=1.2,
              label=f"y = {fit.slope:.4f}x {fit.intercept:+.4f}")  # fmt: skip
    near.plot(xs, paper.slope * xs + paper.intercept, color=_COLOURS[1], lw=1.2, ls="--",
              label=f"paper: y = {paper.slope:.4f}x {paper.intercept:+.4f}")  # fmt: skip
    near.legend(frameon=False)
    far.loglog(*real, ls="", marker="o", color=_COLOURS[0], label="master, through rclpy")
    far.loglog(*core, ls="", marker="s", color=_COLOURS[2], label="core alone")
    wide = np.geomspace(1, max(core[0]), 50)
    far.loglog(wide, paper.slope * wide + paper.intercept, color=_COLOURS[1], lw=1.2, ls="--",
               label="paper's line")  # fmt: skip
    far.axhline(100.0, color=_INK, lw=1.0, ls=(0, (6, 4)), label="one cycle, 100 ms")
    far.legend(frameon=False, loc="lower right")
    figure.savefig(path, dpi=130)
    plt.close(figure)


def execution_times(path: Path, seconds: dict[str, float]) -> None:
    """Draw Table III as bars.

    Args:
        path: of the .png.
        seconds: by environment, in the paper's order.
    """
    figure, axes = _axes("Execution time [s]", "")
    names = list(seconds)
    axes.barh(names, list(seconds.values()), color=_COLOURS[: len(names)], height=0.6)
    for name, value in seconds.items():
        axes.annotate(f" {value:.1f} s", (value, name), va="center", color=_INK)
    axes.invert_yaxis()
    axes.set_xlim(0, 1.15 * max(seconds.values()))
    _save(figure, axes, path, legend=False)


def _axes(x: str, y: str) -> tuple[Figure, Axes]:
    figure, axes = plt.subplots(figsize=(7.2, 4.4), layout="constrained")
    _dress(axes, x, y)
    return figure, axes


def _dress(axes: Axes, x: str, y: str) -> None:
    axes.set_xlabel(x, color=_INK)
    axes.set_ylabel(y, color=_INK)
    axes.spines[["top", "right"]].set_visible(False)
    axes.set_axisbelow(True)
    axes.grid(color=_FAINT, lw=0.6)


def _save(figure: Figure, axes: Axes, path: Path, *, legend: bool = True) -> None:
    if legend:
        axes.legend(frameon=False, loc="lower right")
    figure.savefig(path, dpi=130)
    plt.close(figure)
