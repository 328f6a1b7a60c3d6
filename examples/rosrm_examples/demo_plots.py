"""Plots of a demo: memory over time, assignments and migrations of each process, the queue.

python -m rosrm_examples.demo_plots out/demo      redraws usage.png
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import matplotlib as mpl
import numpy as np

from rosrm_examples.arrays import Floats
from rosrm_examples.demo_job import kind_of
from rosrm_examples.demo_record import Record

mpl.use("Agg")
from matplotlib import pyplot as plt  # after the backend is chosen
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator

USAGE_FILE: Final = "usage.png"

PAPER, INK, QUIET, FAINT = "#fbfaf7", "#22303c", "#8b949c", "#e4e2db"
_COLOURS: Final = ("#00798c", "#d1495b", "#c98a1b")
_WAITING: Final = "#b9c3cc"
#: Marker, size, line width and label for an assignment of each kind of process.
_MARKS: Final = {
    "piece": ("s", 22, 0.0, "SLAM piece"),
    "holder": ("|", 48, 1.5, "holder"),
    "recorder": ("D", 30, 0.0, "recorder"),
}
#: Seconds; marks of one lane that are nearer to each other are drawn in rows.
_TOGETHER_S: Final = 0.4
_ROWS: Final = (0.0, 0.32, -0.32)


def draw_usage(path: Path, record: Record, title: str) -> None:
    """Draw the record as a .png: utilisation of memory, assignments, migrations, and the queue."""
    figure, (usage, lanes, queue) = plt.subplots(
        3, 1, figsize=(11, 8.2), sharex=True, layout="constrained", facecolor=PAPER,
        height_ratios=(5, 2.2, 1.1),
    )  # fmt: skip
    _draw_memory(usage, record)
    _draw_lanes(lanes, record)
    _draw_queue(queue, record)
    for axes in (usage, lanes, queue):
        dress(axes)
    figure.suptitle(title, color=INK, x=0.056, ha="left")
    queue.set_xlabel("elapsed time (s)", color=INK)
    queue.set_xlim(-1, max(_times(record)[-1], 1.0))
    figure.align_ylabels()
    figure.savefig(path, dpi=130)
    plt.close(figure)


def colour_of(record: Record, host: str) -> str:
    """Return the colour of a host in every part of the picture."""
    return _COLOURS[record.hosts.index(host) % len(_COLOURS)]


def memory_of(record: Record, host: str) -> Floats:
    """Return the (S,) utilisation of a host's memory, percent; NaN where it is not known."""
    seen = (sample.usage.get("memory", {}).get(host) for sample in record.samples)
    return 100 * np.array([np.nan if value is None else value for value in seen])


def _times(record: Record) -> Floats:
    """Return the (S,) seconds since the first process was submitted."""
    return np.array([sample.elapsed for sample in record.samples]) - record.start


def _draw_memory(axes: Axes, record: Record) -> None:
    times, limit = _times(record), 100 * record.limits["memory"]
    for host in record.hosts:
        axes.plot(times, memory_of(record, host), color=colour_of(record, host), lw=1.9, label=host)
    axes.axhline(limit, color=INK, lw=1.1, ls=(0, (6, 4)), label=f"limit {limit:.0f} %")
    _mark_limit_reached(axes, record, limit)
    for move in record.moves():
        axes.axvline(move.elapsed - record.start, color=QUIET, lw=0.9, ls=":")
    axes.set_ylim(0, 100)
    axes.set_ylabel("memory utilisation (%)", color=INK)
    handles, _ = axes.get_legend_handles_labels()
    handles += [
        Line2D([], [], ls="", marker="v", color=INK, label="limit reached"),
        Line2D([], [], color=QUIET, lw=0.9, ls=":", label="migration"),
    ]
    draw_legend(axes, handles=handles)


def _mark_limit_reached(axes: Axes, record: Record, limit: float) -> None:
    for event in record.of_kind("over_limit"):
        if event.facts.get("resource") == "memory":
            axes.plot(
                event.elapsed - record.start, limit + 5.5, marker="v", ms=6.5, mew=0,
                color=colour_of(record, event.host), zorder=4,
            )  # fmt: skip


def _draw_lanes(axes: Axes, record: Record) -> None:
    """Draw a lane for each host, with its assignments, and the migrations between lanes."""
    lane = {host: -1.25 * number for number, host in enumerate(record.hosts)}
    for host, y in lane.items():
        _draw_lane(axes, record, host, y)
    for move in record.moves():
        at = move.elapsed - record.start
        axes.annotate(
            "", (at, lane[move.destination]), (at, lane[move.source]),
            arrowprops={"arrowstyle": "-|>", "color": INK, "lw": 1.3, "shrinkA": 0, "shrinkB": 0},
        )  # fmt: skip
    axes.set_ylim(min(lane.values()) - 0.75, 0.75)
    axes.set_yticks([])
    handles: list[Line2D] = [
        Line2D([], [], ls="", marker=marker, ms=size**0.5, mew=mew, color=INK, label=words)
        for marker, size, mew, words in _MARKS.values()
    ]
    handles.append(
        Line2D([], [], ls="", marker=r"$\downarrow$", ms=9, color=INK, label="migration")
    )
    draw_legend(axes, handles=handles, handletextpad=0.3, title="assignments")


def _draw_lane(axes: Axes, record: Record, host: str, y: float) -> None:
    colour = colour_of(record, host)
    axes.axhspan(y - 0.5, y + 0.5, color=FAINT, alpha=0.55, zorder=0, linewidth=0)
    axes.text(
        -0.008, y, host, color=colour, ha="right", va="center",
        transform=axes.get_yaxis_transform(),
    )  # fmt: skip
    events = [event for event in record.of_kind("assigned") if event.host == host]
    times = [event.elapsed - record.start for event in events]
    for event, at, row in zip(events, times, stacked(times), strict=True):
        marker, size, mew, _ = _MARKS[kind_of(event.process)]
        axes.scatter(
            at, y + _ROWS[row % len(_ROWS)], marker=marker, s=size, linewidths=mew, color=colour
        )


def stacked(times: Sequence[float]) -> list[int]:
    """Return the row of each mark, so that marks close in time do not cover each other."""
    rows: list[int] = []
    for number, at in enumerate(times):
        together = number > 0 and at - times[number - 1] < _TOGETHER_S
        rows.append(rows[-1] + 1 if together else 0)
    return rows


def _draw_queue(axes: Axes, record: Record) -> None:
    waiting = [sample.waiting for sample in record.samples]
    axes.fill_between(_times(record), waiting, color=_WAITING, step="post", linewidth=0)
    axes.set_ylim(0, max(4, *waiting) * 1.15)
    axes.set_ylabel("queue", color=INK)
    axes.yaxis.set_major_locator(MaxNLocator(nbins=3, integer=True))


def draw_legend(axes: Axes, **options: Any) -> None:
    """Draw the legend above the axes, to the left."""
    legend = axes.legend(
        frameon=False, labelcolor=INK, ncols=7, loc="lower left", bbox_to_anchor=(-0.01, 0.985),
        columnspacing=1.6, alignment="left", **{"handlelength": 1.8, **options},
    )  # fmt: skip
    legend.get_title().set_color(INK)


def dress(axes: Axes) -> None:
    """Give axes the colours of all pictures, without a frame."""
    axes.set_facecolor(PAPER)
    axes.tick_params(colors=QUIET, length=3)
    axes.spines[["top", "right", "left"]].set_visible(False)
    axes.spines["bottom"].set_color(FAINT)
    axes.set_axisbelow(True)
    axes.grid(axis="y", color=FAINT, lw=0.7)


def main(arguments: Sequence[str]) -> int:
    """Draw usage.png from samples.json and events.jsonl in a folder; return the exit status."""
    if len(arguments) != 1:
        print("usage: python -m rosrm_examples.demo_plots FOLDER", file=sys.stderr)
        return 2
    folder = Path(arguments[0])
    try:
        record = Record.read(folder)
        draw_usage(folder / USAGE_FILE, record, title_of(record))
    except (OSError, ValueError, KeyError, TypeError) as error:
        print(f"demo_plots: {folder} holds no record of a demo: {error}", file=sys.stderr)
        return 2
    print(folder / USAGE_FILE)
    return 0


def title_of(record: Record) -> str:
    """Return one line above the picture."""
    processes = sum(1 for _ in record.of_kind("submitted"))
    return (
        f"{processes} processes on {len(record.hosts)} hosts of {record.budget / 2**20:.0f} MiB, "
        f"migrations: {len(record.moves())}"
    )


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
