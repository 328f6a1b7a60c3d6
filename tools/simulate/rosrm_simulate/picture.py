"""Picture of the runs of `rosrm simulate`: memory and CPU of every host, one row a run."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path
from typing import Any, Final

import numpy as np

from rosrm.errors import ConfigError, RosrmError
from rosrm.wording import reason_of
from rosrm_simulate.meter import MEASURED
from rosrm_simulate.runs import SimulationReport, SimulationRun

_FORMATS: Final = (".png", ".svg", ".pdf")
#: Most hosts with a legend beside the curves; more would hide them.
_NAMED: Final = 8
_HEIGHT: Final = 2.4


def check(path: Path) -> None:
    """Raise an error before a long run, if its picture could not be drawn."""
    if find_spec("matplotlib") is None:
        raise RosrmError(
            "--plot needs matplotlib, which is not installed: pip install 'rosrm-simulate[plot]'"
        )
    if path.suffix not in _FORMATS:
        raise ConfigError(f"--plot {path}: the name has to end with {', '.join(_FORMATS)}")
    if not path.absolute().parent.is_dir():
        raise ConfigError(f"--plot {path}: there is no directory {path.absolute().parent}")


def draw(report: SimulationReport, path: Path) -> None:
    """Draw all runs into a file; raises `RosrmError` where it cannot be written."""
    from matplotlib.figure import Figure  # noqa: PLC0415 - an extra: `check` has looked for it

    rows = len(report.runs)
    figure = Figure(figsize=(11.0, 0.8 + _HEIGHT * rows), layout="constrained")
    axes = figure.subplots(rows, len(MEASURED), squeeze=False, sharex=True, sharey="col")
    for row, run in enumerate(report.runs):
        for column, resource in enumerate(MEASURED):
            _draw_usage(axes[row][column], run, resource)
    for column in range(len(MEASURED)):
        axes[-1][column].set_xlabel("time / s")
    figure.suptitle(report.workload.name)
    try:
        figure.savefig(path, dpi=110)
    except OSError as error:
        raise RosrmError(f"--plot {path}: cannot be written: {reason_of(error)}") from None


def _draw_usage(axis: Any, run: SimulationRun, resource: str) -> None:
    curves = run.outcome.curves
    for column, host in enumerate(curves.hosts):
        label = host if len(curves.hosts) <= _NAMED else None
        usage = curves.usage[resource][:, column] * 100.0
        axis.plot(curves.times, usage, linewidth=1.0, drawstyle="steps-post", label=label)
    for limit in np.unique(curves.limit[resource] * 100.0):
        axis.axhline(limit, color="black", linestyle="--", linewidth=0.8)
    axis.set_title(f"{run.name}: {resource}", fontsize=9, loc="left")
    axis.set_ylabel("usage / %")
    axis.set_ylim(bottom=0.0)
    axis.grid(visible=True, alpha=0.3)
    if curves.hosts and len(curves.hosts) <= _NAMED:
        axis.legend(fontsize=7, loc="upper right")
