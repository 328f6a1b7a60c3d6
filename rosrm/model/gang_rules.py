"""Rules on gangs that can never start: all processes of a gang are placed in one step."""

from __future__ import annotations

from collections import Counter
from collections.abc import Hashable, Iterable, Mapping, Sequence
from itertools import pairwise
from typing import NamedTuple

from rosrm.model.dependencies import circle_in
from rosrm.model.values import ProcessSpec
from rosrm.wording import counted, listed

#: Owner and name of a gang.
Gang = tuple[str, str]


class GangFault(NamedTuple):
    """A gang that can never start.

    Attributes:
        process: a process of it, or one after which it starts.
        path: path of the faulty field.
        text: a sentence.
    """

    process: str
    path: tuple[str, ...]
    text: str


def gang_array_fault(
    gang_of: Mapping[str, Gang], specs: Mapping[str, ProcessSpec]
) -> GangFault | None:
    """Return a gang for which an array has too few places; None: there is none.

    Args:
        gang_of: name of each process that starts with its gang to that gang.
        specs: their specs by name.
    """
    jobs = Counter((gang_of[name], specs[name].array.name) for name in gang_of)
    for name, gang in gang_of.items():
        array = specs[name].array
        if 0 < array.parallel < (number := jobs[gang, array.name]):
            return GangFault(
                name, ("together",),
                f"together: {number} jobs of the array {array.name} are in the gang {gang[1]} and "
                f"start at once, but `parallel` lets {counted(array.parallel, 'job')} run at a "
                f"time: use `parallel: {number}` or more, or remove one of both",
            )  # fmt: skip
    return None


def gang_order_fault(
    gang_of: Mapping[str, Gang], after: Mapping[str, Iterable[str]]
) -> GangFault | None:
    """Return a gang whose processes wait for each other; None: there is none.

    Args:
        gang_of: as in `gang_array_fault`.
        after: name of each process to those after which it starts; without a circle.
    """
    waits = _circle_of_gangs(gang_of, after)
    if not waits:
        return None
    gangs = dict.fromkeys(gang_of[name][1] for pair in waits for name in pair if name in gang_of)
    orders = listed(f"{name} starts after {other}" for name, other in waits)
    each = "the gang" if len(gangs) == 1 else "each of the gangs"
    return GangFault(
        waits[0][0], ("after", waits[0][1]),
        f"after: {orders}, but {each} {listed(gangs)} starts at once, so it never starts: remove "
        f"one of the orders, or `together` of one process",
    )  # fmt: skip


def _circle_of_gangs(
    gang_of: Mapping[str, Gang], after: Mapping[str, Iterable[str]]
) -> Sequence[tuple[str, str]]:
    """Return a circle of gangs and single processes that wait for each other; (): there is none.

    Returns:
        Of each of them, a process and the one of the next after which it starts.
    """
    waits: dict[tuple[Hashable, Hashable], tuple[str, str]] = {}
    graph: dict[Hashable, list[Hashable]] = {}
    for name, others in after.items():
        for other in others:
            pair = gang_of.get(name, name), gang_of.get(other, other)
            waits.setdefault(pair, (name, other))
            graph.setdefault(pair[0], []).append(pair[1])
    return [waits[pair] for pair in pairwise(circle_in(graph))]
