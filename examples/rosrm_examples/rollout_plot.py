"""Picture of a rolling replacement: the instances of each process over time, by version.

python -m rosrm_examples.rollout_plot out/rollout      redraws rollout.png
"""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Final

import numpy as np
from matplotlib import pyplot as plt
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from rosrm_examples.demo_plots import FAINT, INK, PAPER, QUIET, draw_legend, dress
from rosrm_examples.demo_record import Record
from rosrm_examples.rollout_job import APPLICATION, HEALTHY_FOR, RECORDER, SLAM, VIEWER
from rosrm_examples.rollout_record import Rollout, Span, rollout_of

ROLLOUT_FILE: Final = "rollout.png"
POSES_FILE: Final = "poses.json"

_COLOURS: Final = {1: "#00798c", 2: "#c98a1b", 3: "#d1495b"}
#: Processes with a lane each, and the way in which they are replaced.
_LANES: Final = {SLAM: "handoff", VIEWER: "relaunch", RECORDER: "stop, start"}
#: Heights in a lane of one unit: the rows of consecutive instances, a bar, the check of its health.
_ROWS: Final = (0.2, -0.2)
_BAR: Final = 0.3
_CHECK_BELOW: Final = 0.19


def draw_rollout(path: Path, record: Record, poses: Sequence[float]) -> None:
    """Draw a run as a .png: desired versions, instances of each process, outputs of the SLAM.

    Args:
        poses: unix time of each pose of the SLAM.
    """
    rollout = rollout_of(record.events, list(_LANES))
    figure, (lanes, outputs) = plt.subplots(
        2, 1, figsize=(11, 6.2), sharex=True, layout="constrained", facecolor=PAPER,
        height_ratios=(4.4, 1),
    )  # fmt: skip
    _draw_versions(lanes, rollout)
    for number, process in enumerate(_LANES, start=1):
        _draw_lane(lanes, rollout, process, -float(number))
    lanes.set_ylim(-len(_LANES) - 0.6, 0.5)
    lanes.set_yticks([])
    _draw_outputs(outputs, record, rollout, poses)
    for axes in (lanes, outputs):
        dress(axes)
    lanes.grid(visible=False)
    _draw_key(lanes)
    figure.suptitle(_title(rollout), color=INK, x=0.075, ha="left")
    outputs.set_xlabel("elapsed time (s)", color=INK)
    outputs.set_xlim(0, rollout.end)
    figure.savefig(path, dpi=130)
    plt.close(figure)


def _title(rollout: Rollout) -> str:
    faulty = next((a.version for a, b in pairwise(rollout.requests) if b.returned), None)
    end = "" if faulty is None else f"; version {faulty} fails, and the version before returns"
    versions = len({request.version for request in rollout.requests})
    return f"application {APPLICATION}: {versions} versions while a drive is mapped{end}"


def _draw_versions(axes: Axes, rollout: Rollout) -> None:
    """Draw the desired version as a band above the lanes."""
    _name(axes, 0.0, APPLICATION, "desired")
    ends = [*(request.at for request in rollout.requests[1:]), rollout.end]
    for request, end in zip(rollout.requests, ends, strict=True):
        axes.barh(
            0.0, end - request.at, 0.42, left=request.at, color=_COLOURS[request.version], lw=0
        )
        axes.text(
            request.at + 0.3, 0.0, f"version {request.version}" + " again" * request.returned,
            color=PAPER, va="center",
        )  # fmt: skip
        axes.axvline(request.at, color=QUIET, lw=0.9, ls=":", zorder=0)


def _draw_lane(axes: Axes, rollout: Rollout, process: str, y: float) -> None:
    axes.axhspan(y - 0.44, y + 0.44, color=FAINT, alpha=0.55, zorder=0, linewidth=0)
    _name(axes, y, process, _LANES[process])
    for number, span in enumerate(rollout.of(process)):
        _draw_span(axes, rollout, span, y + _ROWS[number % len(_ROWS)])


def _draw_span(axes: Axes, rollout: Rollout, span: Span, y: float) -> None:
    """Draw an instance: as a shadow, as the owner of its name, until it has ended."""
    colour, end = _COLOURS[span.version], min(span.end, rollout.end)
    active, successor = min(span.active, end), min(span.successor, end)
    for begin, until, alpha in ((span.begin, active, 0.35), (active, successor, 1.0),
                                (successor, end, 0.35)):  # fmt: skip
        if until > begin:
            axes.barh(y, until - begin, _BAR, left=begin, color=colour, alpha=alpha, lw=0)
    if span.failed:
        axes.plot(end, y, marker="X", ms=9, color=INK, mec=PAPER, zorder=5)
    if span.checked < end:
        until = rollout.healthy_until(span, HEALTHY_FOR)
        below = y - _CHECK_BELOW
        axes.plot([span.checked, until], [below, below], color=INK, lw=1.2, marker="|", ms=5)


def _name(axes: Axes, y: float, name: str, below: str) -> None:
    """Write the name of a lane, and a word below it, to its left."""
    for text, colour, shift in ((name, INK, 0.12), (below, QUIET, -0.14)):
        axes.text(
            -0.008, y + shift, text, color=colour, ha="right", va="center",
            transform=axes.get_yaxis_transform(),
        )  # fmt: skip


def _draw_outputs(axes: Axes, record: Record, rollout: Rollout, poses: Sequence[float]) -> None:
    """Draw the time from each pose to the next one, in the colour of the version that made it."""
    clock = record.events[0].wall_time - record.events[0].elapsed
    times = np.array(poses) - clock
    slam = Rollout(spans=dict(enumerate(rollout.of(SLAM))))
    colours = [_COLOURS.get(slam.version_at(at), QUIET) for at in times[1:]]
    axes.scatter(times[1:], 1e3 * np.diff(times), s=6, color=colours, linewidths=0)
    axes.set_ylim(0, None)
    axes.set_ylabel("ms between\ntwo poses", color=INK)


def _draw_key(axes: Axes) -> None:
    handles = [
        Patch(color=QUIET, label="runs as the process"),
        Patch(color=QUIET, alpha=0.35, lw=0, label="beside it: starts, or stops"),
        Line2D([], [], color=INK, lw=1.2, marker="|", ms=5,
               label=f"must stay healthy for {HEALTHY_FOR:g} s"),
        Line2D([], [], ls="", marker="X", ms=8, color=INK, mec=PAPER, label="fails"),
    ]  # fmt: skip
    draw_legend(axes, handles=handles)


def main(arguments: Sequence[str]) -> int:
    """Draw rollout.png from the record in a folder; return the exit status."""
    if len(arguments) != 1:
        print("usage: python -m rosrm_examples.rollout_plot FOLDER", file=sys.stderr)
        return 2
    folder = Path(arguments[0])
    try:
        poses = json.loads((folder / POSES_FILE).read_text())
        draw_rollout(folder / ROLLOUT_FILE, Record.read(folder), poses)
    except (OSError, ValueError, KeyError, TypeError, IndexError) as error:
        print(f"rollout_plot: {folder} holds no record of a rollout: {error}", file=sys.stderr)
        return 2
    print(folder / ROLLOUT_FILE)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
