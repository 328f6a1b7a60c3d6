"""Places of arrays for processes in the queue: a gang takes all of its places in one step, or none.

A job takes a place by its assignment. So a job that waits for anything else holds no place back.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from types import MappingProxyType
from typing import Final

from rosrm.core.master.assignment.gangs import members_of
from rosrm.core.master.master_state import MasterState
from rosrm.core.master.state.arrays import ArrayKey, array_of
from rosrm.core.master.state.process import Process

_NO_PLACES: Final[Mapping[ArrayKey, int]] = MappingProxyType({})


def why_no_place(state: MasterState, process: Process) -> str:
    """Return why an array has no place now for a process and its gang; "": each has one."""
    array = array_without_place(state, process)
    if array is None:
        return ""
    taken, name = len(state.queue.arrays.taken.get(array, ())), array[1]
    run = f"{taken} of the array {name} run{'s' * (taken == 1)} already"
    number = wanted_places(state, process)[array]
    if number > 1:
        return f"{run}, and {number} of the gang {process.spec.together} start at once"
    if _is_reserved(state, process, array):
        return f"a gang before it waits for places of the array {name}"
    return run


def array_without_place(
    state: MasterState, process: Process, beside: Mapping[ArrayKey, int] = _NO_PLACES
) -> ArrayKey | None:
    """Return an array without a place now for a process or another one of its gang; None: none.

    `beside`: number of places of each array that others take before.
    """
    if not state.queue.has_bounds:
        return None
    members = members_of(state, process)
    wanted = wanted_places(state, process) if len(members) > 1 else _NO_PLACES
    for one in members:
        bound = one.spec.array.parallel
        if bound:
            array = array_of(one)
            number = wanted.get(array, 1) + beside.get(array, 0)
            if not state.queue.arrays.are_free(array, bound, number):
                return array
            if _is_reserved(state, process, array):
                return array
    return None


def reserve_places(state: MasterState, process: Process) -> None:
    """Let no process behind a gang take a place of an array for which the gang waits."""
    arrays = state.queue.arrays
    for array in wanted_places(state, process):
        arrays.reserved.setdefault(array, state.queue.key_of(process.name))


def wanted_places(state: MasterState, process: Process) -> Counter[ArrayKey]:
    """Return the number of jobs of each array that start in one step with a process."""
    return Counter(array_of(one) for one in members_of(state, process) if one.spec.array.name)


def _is_reserved(state: MasterState, process: Process, array: ArrayKey) -> bool:
    """Return True if a gang before a process waits for places of an array."""
    key = state.queue.arrays.reserved.get(array)
    if key is None or key[2] not in state.queue:
        return False
    # Another member may not be in the queue: it is being stopped on a silent host.
    queued = [one.name for one in members_of(state, process) if one.name in state.queue]
    return key < min(map(state.queue.key_of, queued), default=key)
