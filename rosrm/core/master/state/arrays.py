"""Places of arrays with a bound: a job takes one while it has an instance."""

from __future__ import annotations

from rosrm.core.master.state.process import Process

#: Owner and name of an array.
ArrayKey = tuple[str, str]
#: Place of a process in the order of the queue: priority (negated), order and name.
QueueKey = tuple[int, int, str]


def array_of(process: Process) -> ArrayKey:
    """Return the array of a job; arrays of two users are apart, even with one name."""
    return process.principal, process.spec.array.name


class ArrayPlaces:
    """Places of all arrays.

    Attributes:
        taken: array to the names of its jobs with an instance.
        reserved: array to the place in the queue of the first gang that needs more of its places
            than are free. Processes behind that gang get none of them. Set by each turn of the
            queue.
    """

    def __init__(self) -> None:
        self.taken: dict[ArrayKey, set[str]] = {}
        self.reserved: dict[ArrayKey, QueueKey] = {}
        self._array_of: dict[str, ArrayKey] = {}

    def note_change(self, process: Process) -> bool:
        """Update the place of a job by its instances; return True if it took or freed one."""
        name = process.name
        array = array_of(process) if process.spec.array.name and process.instances else None
        former = self._array_of.get(name)
        if array == former:
            return False
        if former is not None:
            del self._array_of[name]
            self.taken[former].remove(name)
            if not self.taken[former]:
                del self.taken[former]
        if array is not None:
            self._array_of[name] = array
            self.taken.setdefault(array, set()).add(name)
        return True

    def are_free(self, array: ArrayKey, bound: int, number: int = 1) -> bool:
        """Return True if a number of further jobs may get an instance; a `bound` of 0 is none."""
        return not bound or len(self.taken.get(array, ())) + number <= bound
