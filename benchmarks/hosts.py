"""Hosts for the benchmarks: slices of this machine, large enough not to limit a measurement."""

from __future__ import annotations

from rosrm.config.settings import HostConfig

GIB = 2.0**30


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
