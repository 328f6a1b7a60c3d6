"""Places of arrays that bound their jobs at a time; jobs without one wait outside of the queue."""

from __future__ import annotations

from bisect import bisect_left, insort
from collections.abc import Callable, Iterator

from rosrm.core.master.state.process import Process

#: Owner and name of an array.
_Array = tuple[str, str]
#: Priority (negated), order and name of a waiting job.
_Key = tuple[int, int, str]


class ArrayPlaces:
    """Places of arrays: at most `parallel` jobs of each are in the queue or have an instance."""

    def __init__(self) -> None:
        self._waiting: dict[_Array, list[_Key]] = {}
        self._taken: dict[_Array, set[str]] = {}
        self._places: dict[str, tuple[_Array, _Key]] = {}
        self._most: dict[_Array, int] = {}
        self._changed: dict[_Array, None] = {}

    def __contains__(self, name: str) -> bool:
        return name in self._places

    def __iter__(self) -> Iterator[str]:
        return iter(list(self._places))

    def add(self, process: Process) -> None:
        """Let a job wait for a place; a job that returns with its old order gets its old turn."""
        array = _array_of(process)
        key = (-process.spec.priority, process.order, process.name)
        self._places[process.name] = array, key
        self._most[array] = process.spec.array.parallel
        insort(self._waiting.setdefault(array, []), key)
        self._changed[array] = None

    def remove(self, process: Process) -> None:
        """Take a job from those that wait, or note that it has left the queue."""
        if process.name in self._places:
            array, key = self._places.pop(process.name)
            waiting = self._waiting[array]
            del waiting[bisect_left(waiting, key)]
        self.note_change(process)

    def note_change(self, process: Process) -> None:
        """Note that a job has a place, or may have lost it."""
        if process.spec.array.parallel and process.name not in self._places:
            array = _array_of(process)
            self._taken.setdefault(array, set()).add(process.name)
            self._changed[array] = None

    def taken(self, process: Process) -> set[str]:
        """Return the names of the jobs of an array that have a place."""
        return self._taken.get(_array_of(process), set())

    def admitted(self, has_place: Callable[[str], bool]) -> Iterator[str]:
        """Yield the jobs that get a place, in order.

        `has_place`: returns True for a job that is in the queue or has an instance.
        """
        for array in self._changed:
            taken = self._taken[array] = set(filter(has_place, self._taken.get(array, ())))
            waiting = self._waiting.get(array, [])
            free = max(0, self._most.get(array, 0) - len(taken))
            for _, _, name in waiting[:free]:
                del self._places[name]
                taken.add(name)
                yield name
            del waiting[:free]
            if not waiting and not taken:
                self._forget(array)
        self._changed.clear()

    def _forget(self, array: _Array) -> None:
        self._waiting.pop(array, None)
        self._taken.pop(array, None)
        self._most.pop(array, None)


def _array_of(process: Process) -> _Array:
    return process.principal, process.spec.array.name
