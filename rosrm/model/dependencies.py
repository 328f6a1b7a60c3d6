"""Rules on processes that start after each other."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from graphlib import CycleError, TopologicalSorter

from rosrm.model.values import Kind, ProcessSpec, StartCondition


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


def condition_fault(dependency: ProcessSpec, condition: StartCondition) -> str:
    """Return why no process can await this condition of a dependency; "": it can."""
    if condition != "finished" or dependency.kind is Kind.JOB:
        return ""
    name = dependency.name
    return f"{name} is a service, which does not finish; use `ready` or declare it as a job"


def circle_fault(circle: Sequence[str]) -> str:
    """Return a sentence on a circle."""
    return f"after: {' -> '.join(circle)} is a circle, in which each process starts after the next"
