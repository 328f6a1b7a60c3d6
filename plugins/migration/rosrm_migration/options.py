"""A process's own options of a strategy, over those of the cluster."""

from __future__ import annotations

from math import inf
from typing import Any, TypeVar

from rosrm.config.plain import from_plain, to_plain
from rosrm.core.model import ProcessSpec

T = TypeVar("T")


def options_of(spec: ProcessSpec, cluster: T) -> T:
    """What holds for one process.

    Args:
        spec: its `migration.options` are given by name.
        cluster: the strategy's options for all processes.

    Raises:
        ValueError: for an unknown option, or a value that makes no sense.
    """
    given = spec.migration.options
    return from_plain(type(cluster), {**to_plain(cluster), **given}) if given else cluster


def check_seconds(options: Any, *names: str) -> None:
    """Raise `ValueError` for a wait that is no time."""
    for name in names:
        seconds = getattr(options, name)
        if not 0.0 < seconds < inf:
            raise ValueError(f"{name} is {seconds:g} s; allowed: more than 0")
