"""Rules on processes that start after each other."""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Mapping, Sequence
from contextlib import suppress
from graphlib import CycleError, TopologicalSorter
from typing import TypeVar

from rosrm.model.values import Kind, ProcessSpec, StartCondition

Name = TypeVar("Name", bound=Hashable)


def circle_in(after: Mapping[Name, Iterable[Name]]) -> Sequence[Name]:
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


def in_order(after: Mapping[str, Iterable[str]]) -> list[str]:
    """Return the processes, each one behind those after which it comes.

    Those of a circle, and those behind it, are the last. No circle may come into force, but the
    journal of an older master may have one, which must not end each master that reads it.

    Args:
        after: as in `circle_in`.
    """
    sorter, found = TopologicalSorter(after), list[str]()
    with suppress(CycleError):  # the sorter still yields what is in no circle
        sorter.prepare()
    while sorter.is_active():
        ready = sorter.get_ready()
        sorter.done(*ready)
        found += ready
    return list(dict.fromkeys((*found, *after)))


def condition_fault(dependency: ProcessSpec, condition: StartCondition) -> str:
    """Return why no process can await this condition of a dependency; "": it can."""
    name = dependency.name
    if condition != "finished":
        return ""
    if dependency.kind is not Kind.JOB:
        return f"{name} is a service, which does not finish; use `ready` or declare it as a job"
    if dependency.schedule:
        return f"{name} has a schedule, so it never finishes; use `ready`, or remove its schedule"
    return ""


def circle_fault(circle: Sequence[str]) -> str:
    """Return a sentence on a circle."""
    return f"after: {' -> '.join(circle)} is a circle, in which each process starts after the next"
