"""Command line and report of a benchmark, with the machine, the versions, the load and the runs."""

from __future__ import annotations

import argparse
import importlib.metadata
import json
import os
import platform
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from rosrm.testing.loopback import enter_private_network
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


class _Help(argparse.ArgumentDefaultsHelpFormatter, argparse.RawDescriptionHelpFormatter):
    """Help with the lines of the description as they are, and the default of each option."""


def parser(description: str | None) -> argparse.ArgumentParser:
    """Return the parser of a benchmark's command line; `description` is its docstring."""
    return argparse.ArgumentParser(description=description, formatter_class=_Help)


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


def percentile(values: Sequence[float], fraction: float) -> float:
    """Return the value below which a fraction of the sorted values lies (nearest rank)."""
    ordered = sorted(values)
    return ordered[min(len(ordered) - 1, int(fraction * len(ordered)))]


def quantiles(name: str, seconds: Sequence[float]) -> dict[str, float | None]:
    """Return median and 99th percentile as `NAME_p50_s` and `NAME_p99_s`; None: no values."""
    return {
        f"{name}_p{percent}_s": round(percentile(seconds, percent / 100), 3) if seconds else None
        for percent in (50, 99)
    }


def milliseconds(name: str, seconds: Sequence[float]) -> dict[str, float | None]:
    """Return median and 99th percentile as `NAME_p50_ms` and `NAME_p99_ms`; None: no values."""
    return {
        f"{name}_p{percent}_ms": (
            round(1e3 * percentile(seconds, percent / 100), 1) if seconds else None
        )
        for percent in (50, 99)
    }


def isolated_transports() -> str:
    """Enter a network namespace if permitted; return the DDS transports used."""
    alone = enter_private_network()
    return "UDPv4, in a network namespace" if alone else "default, LOCALHOST"


def _processor() -> str:
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        for line in cpuinfo.read_text().splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    return platform.machine()
