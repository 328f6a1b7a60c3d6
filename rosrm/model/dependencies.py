"""Circles of processes that start after each other."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from graphlib import CycleError, TopologicalSorter


def circle_in(after: Mapping[str, Iterable[str]]) -> Sequence[str]:
    """Return a circle of processes, each of which starts after the next one; (): there is none.

    Args:
        after: name of each process to the processes after which it starts.

    Returns:
        The names; the first is also the last.
    """
    try:
        TopologicalSorter(after).prepare()
    except CycleError as error:
        return tuple(reversed(error.args[1]))
    return ()


def circle_fault(circle: Sequence[str]) -> str:
    """Return a sentence on a circle."""
    return f"after: {' -> '.join(circle)} is a circle, in which each process starts after the next"
