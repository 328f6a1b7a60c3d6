"""Hosts for the benchmarks: slices of this machine, large enough not to limit a measurement."""

from __future__ import annotations

import argparse
from dataclasses import replace
from typing import Literal, get_args

from rosrm.config.settings import ClusterConfig, HostConfig

GIB = 2.0**30
Sync = Literal["normal", "full"]


def three_hosts(*, max_processes: int = 0) -> list[HostConfig]:
    """Return the configurations of three equal slices.

    Args:
        max_processes: most processes held at a time; 0: no bound.
    """
    return [
        HostConfig(
            host=f"host{number}", scope="slice", max_processes=max_processes,
            budget={"memory": 16 * GIB, "cpu": 64.0, "disk": 16 * GIB},
        )
        for number in range(3)
    ]  # fmt: skip


def add_sync(command_line: argparse.ArgumentParser) -> None:
    """Add the option `--sync` of the master's journal."""
    command_line.add_argument(
        "--sync", choices=get_args(Sync), default="normal", help="journal.sync of the master"
    )


def with_journal(sync: Sync) -> ClusterConfig:
    """Return the default settings of a master with this `journal.sync`."""
    settings = ClusterConfig()
    return replace(settings, journal=replace(settings.journal, sync=sync))
