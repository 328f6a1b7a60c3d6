"""Pictures of maps from above, with the trajectory and the true one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import matplotlib as mpl
import numpy as np

from rosrm_examples.arrays import Flags, Floats, Keys, Points

mpl.use("Agg")
from matplotlib import pyplot as plt  # after the backend is chosen
from matplotlib.axes import Axes
from matplotlib.figure import Figure

_PAPER, _INK, _QUIET = "#fbfaf7", "#22303c", "#8b949c"
_DRIVEN, _TRUE = "#d1495b", "#00798c"
_SIDE_M = 35.0  # margin of the map beside the trajectory


@dataclass(frozen=True)
class Stretch:
    """A stretch of the drive that one instance mapped.

    Attributes:
        label: For the legend.
        colour: A colour of matplotlib.
        points: (P, 3) metres.
        trajectory: (S, 3) positions, metres.
        numbers: (S,) of the scans that were mapped there.
    """

    label: str
    colour: str
    points: Points
    trajectory: Floats
    numbers: Keys


def draw_map(
    path: Path, points: Points, trajectory: Floats, truth: Floats | None, title: str
) -> None:
    """Draw the map as a .png.

    Args:
        path: Where to write it.
        points: (P, 3) map, metres.
        trajectory: (S, 3) positions, metres.
        truth: (S, 3) true positions, metres, or None.
        title: One line above the picture.
    """
    figure, axes = _from_above(trajectory)
    shown = points[_in_sight(axes, points)]
    shown = shown[np.argsort(shown[:, 2])]  # high points over low ones, as seen from above
    if len(shown):
        axes.scatter(
            shown[:, 0],
            shown[:, 1],
            s=0.8,
            c=shown[:, 2],
            cmap="bone_r",
            vmin=float(np.percentile(shown[:, 2], 2)) - 2,
            vmax=float(np.percentile(shown[:, 2], 98)),
            linewidths=0,
            rasterized=True,
        )
    axes.plot(trajectory[:, 0], trajectory[:, 1], color=_DRIVEN, lw=2.2, label="NDT SLAM")
    _draw_truth(axes, truth)
    axes.plot(*trajectory[0, :2], "o", color=_DRIVEN, ms=7, mec=_PAPER, label="start")
    _finish(path, figure, axes, title)


def draw_stretches(
    path: Path, stretches: Sequence[Stretch], truth: Floats | None, title: str
) -> None:
    """Draw maps over each other, each in its colour, as a .png.

    Args:
        path: Where to write it.
        stretches: In the order in which they were driven.
        truth: (S, 3) true positions, metres, or None.
        title: One line above the picture.
    """
    figure, axes = _from_above(np.concatenate([one.trajectory for one in stretches]))
    for one in stretches:
        shown = one.points[_in_sight(axes, one.points)]
        axes.scatter(
            shown[:, 0], shown[:, 1], s=0.8, color=one.colour, alpha=0.45, linewidths=0,
            rasterized=True,
        )  # fmt: skip
    _draw_trajectories(axes, stretches)
    _draw_truth(axes, truth)
    _finish(path, figure, axes, title)


def draw_errors(path: Path, stretches: Sequence[Stretch], truth: Floats | None, title: str) -> None:
    """Draw the trajectory and the true one, and the distance between them, as a .png."""
    driven = np.concatenate([one.trajectory for one in stretches])
    width, height = np.ptp(driven[:, :2], axis=0)
    tall = float(np.clip(10 * height / max(width, 1.0), 2.0, 10.0))  # inches
    figure, (above, errors) = plt.subplots(
        2, 1, figsize=(11, tall + 4), layout="constrained", facecolor=_PAPER,
        height_ratios=(tall, 2.5),
    )  # fmt: skip
    _draw_trajectories(above, stretches)
    _draw_truth(above, truth)
    above.set(aspect="equal", adjustable="datalim")
    if truth is not None:
        for one in stretches:
            apart = np.linalg.norm(one.trajectory - truth[one.numbers], axis=1)
            errors.plot(one.numbers, apart, color=one.colour, lw=2.2)
    errors.set_xlabel("scan", color=_INK)
    errors.set_ylabel("from the truth (m)", color=_INK)
    errors.set_ylim(bottom=0)
    _dress(errors)
    _finish(path, figure, above, title)


def _from_above(trajectory: Floats) -> tuple[Figure, Axes]:
    """Open a picture that shows the surroundings of (S, 3) positions, metres."""
    low = trajectory[:, :2].min(axis=0) - _SIDE_M
    high = trajectory[:, :2].max(axis=0) + _SIDE_M
    width, height = high - low
    figure, axes = plt.subplots(
        figsize=(11, 1.2 + 10 * height / width), layout="constrained", facecolor=_PAPER
    )
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal")
    return figure, axes


def _in_sight(axes: Axes, points: Points) -> Flags:
    low, high = np.array([axes.get_xlim(), axes.get_ylim()]).T
    seen: Flags = ((points[:, :2] > low) & (points[:, :2] < high)).all(axis=1)
    return seen


def _draw_trajectories(axes: Axes, stretches: Sequence[Stretch]) -> None:
    for one in stretches:
        x, y, _ = one.trajectory.T
        axes.plot(x, y, color=one.colour, lw=2.6, label=one.label)
    for one in stretches[1:]:
        axes.plot(*one.trajectory[0, :2], "o", color=_INK, ms=6, mec=_PAPER, label="taken over")


def _draw_truth(axes: Axes, truth: Floats | None) -> None:
    if truth is not None:
        axes.plot(truth[:, 0], truth[:, 1], color=_TRUE, lw=1.4, ls=(0, (4, 3)), label="truth")


def _dress(axes: Axes) -> None:
    axes.set_facecolor(_PAPER)
    axes.tick_params(colors=_QUIET)
    axes.spines[:].set_visible(False)


def _finish(path: Path, figure: Figure, axes: Axes, title: str) -> None:
    _dress(axes)
    axes.set_xlabel("x (m)", color=_INK)
    axes.set_ylabel("y (m)", color=_INK)
    axes.set_title(title, color=_INK, loc="left")
    axes.legend(
        frameon=False, labelcolor=_INK, ncols=4, loc="lower right", bbox_to_anchor=(1.0, 1.0)
    )
    figure.savefig(path, dpi=130)
    plt.close(figure)
