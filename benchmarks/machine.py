"""Conditions of a measurement: the machine, the versions, the load beside it, the runs."""

from __future__ import annotations

import importlib.metadata
import json
import os
import platform
import statistics
import sys
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from rosrm.version import __version__

#: Distributions whose versions may matter, where they are installed.
_DISTRIBUTIONS = (
    "numpy",
    "psutil",
    "rosrm-scoring",
    "rosrm-resources",
    "rosrm-migration",
    "rosrm-checkpoint",
    "rosrm-criu",
    "ros-jazzy-rclpy",
    "ros-jazzy-rmw-fastrtps-cpp",
    "backports.zstd",
    "cryptography",
)


def machine() -> dict[str, Any]:
    """Return a description of this machine, as far as it is readable without root."""
    return {
        "processor": _processor(),
        "cores": len(os.sched_getaffinity(0)),
        "memory_gib": round(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30, 1),
        "system": platform.platform(),
        "load_average": round(os.getloadavg()[0], 2),
    }


def versions() -> dict[str, str]:
    """Return the versions of Python, rosrm and the distributions below it."""
    found = {"python": platform.python_version(), "rosrm": __version__}
    for name in _DISTRIBUTIONS:
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            continue
    return found


def print_report(benchmark: str, figures: Mapping[str, Any], *, runs: int) -> None:
    """Print the figures as one JSON object: the last line of a benchmark.

    `load_average` shows how busy the machine was. On a busy machine the medians are more reliable
    than the means, and all times are too long.
    """
    print(
        json.dumps(
            {
                "benchmark": benchmark, **figures, "runs": runs, "machine": machine(),
                "versions": versions(),
            }
        ),
        flush=True,
    )  # fmt: skip


def say(message: str) -> None:
    """Show progress."""
    print(message, file=sys.stderr, flush=True)


def median(values: Iterable[float]) -> float:
    """Return the median."""
    return statistics.median(values)


def percentile(values: Sequence[float], fraction: float) -> float:
    """Return the value below which a fraction of the sorted values lies (nearest rank)."""
    ordered = sorted(values)
    return ordered[min(len(ordered) - 1, int(fraction * len(ordered)))]


def _processor() -> str:
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        for line in cpuinfo.read_text().splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    return platform.machine()
