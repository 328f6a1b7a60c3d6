"""Draws a map from above, with the trajectory and the true one."""

from __future__ import annotations

from pathlib import Path

import matplotlib as mpl
import numpy as np

from rosrm_examples.arrays import Floats, Points

mpl.use("Agg")
from matplotlib import pyplot as plt  # after the backend is chosen

_PAPER, _INK, _QUIET = "#fbfaf7", "#22303c", "#8b949c"
_DRIVEN, _TRUE = "#d1495b", "#00798c"
_SIDE_M = 35.0  # how far beside the trajectory the map is shown


def draw_map(
    path: Path, points: Points, trajectory: Floats, truth: Floats | None, title: str
) -> None:
    """Draws the map as a .png.

    Args:
        path: Where to write it.
        points: (P, 3) map, metres.
        trajectory: (S, 3) positions, metres.
        truth: (S, 3) true positions, metres, or None.
        title: One line above the picture.
    """
    low = trajectory[:, :2].min(axis=0) - _SIDE_M
    high = trajectory[:, :2].max(axis=0) + _SIDE_M
    width, height = high - low
    figure, axes = plt.subplots(
        figsize=(11, 1.2 + 10 * height / width), layout="constrained", facecolor=_PAPER
    )
    axes.set_facecolor(_PAPER)
    shown = points[((points[:, :2] > low) & (points[:, :2] < high)).all(axis=1)]
    shown = shown[np.argsort(shown[:, 2])]  # high points over low ones, as seen from above
    if len(shown):
        axes.scatter(
            shown[:, 0],
            shown[:, 1],
            s=0.8,
            c=shown[:, 2],
            cmap="bone_r",
            vmin=np.percentile(shown[:, 2], 2) - 2,
            vmax=np.percentile(shown[:, 2], 98),
            linewidths=0,
            rasterized=True,
        )
    axes.plot(trajectory[:, 0], trajectory[:, 1], color=_DRIVEN, lw=2.2, label="NDT SLAM")
    if truth is not None:
        axes.plot(truth[:, 0], truth[:, 1], color=_TRUE, lw=1.4, ls=(0, (4, 3)), label="truth")
    axes.plot(*trajectory[0, :2], "o", color=_DRIVEN, ms=7, mec=_PAPER, label="start")
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal")
    axes.set_xlabel("x (m)", color=_INK)
    axes.set_ylabel("y (m)", color=_INK)
    axes.set_title(title, color=_INK, loc="left")
    axes.tick_params(colors=_QUIET)
    axes.spines[:].set_visible(False)
    axes.legend(
        frameon=False, labelcolor=_INK, ncols=3, loc="lower right", bbox_to_anchor=(1.0, 1.0)
    )
    figure.savefig(path, dpi=130)
    plt.close(figure)
