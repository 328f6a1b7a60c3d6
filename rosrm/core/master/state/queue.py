"""Queue of waiting processes: first in, first out, within a priority."""

from __future__ import annotations

from bisect import bisect_left, bisect_right, insort
from collections.abc import Iterator
from contextlib import contextmanager
from heapq import merge
from typing import Final

from rosrm.core.master.state.arrays import ArrayKey, ArrayPlaces, QueueKey, array_of
from rosrm.core.master.state.process import Process

#: Array and bound of the jobs in a line; None: no bound.
_Line = tuple[ArrayKey, int] | None
#: Number of jobs of a line that are read at a time, because thousands may wait in it.
_AT_ONCE: Final = 100


class Queue:
    """Names of waiting processes in the order of their placement.

    The jobs of each array with a bound form a separate line. While the array has no free place, the
    whole line is skipped, because thousands may wait in it.

    Attributes:
        version: counter of changes.
        delayed: names in it that wait for the end of their delay.
        arrays: places of the arrays.
        awaiting: names in it that wait for other processes, or for an answer of their strategy.
    """

    def __init__(self) -> None:
        self.version = 0
        self.delayed: set[str] = set()
        self.arrays = ArrayPlaces()
        self.awaiting: set[str] = set()
        self._lines: dict[_Line, list[QueueKey]] = {None: []}
        self._of: dict[str, tuple[_Line, QueueKey]] = {}

    def add(self, process: Process) -> None:
        """Queue a process; a process that returns with its old `order` gets its old place."""
        bound = process.spec.array.parallel
        line = (array_of(process), bound) if bound else None
        self._add(process.name, line, (-process.spec.priority, process.order, process.name))

    def _add(self, name: str, line: _Line, key: QueueKey) -> None:
        if name in self._of:
            raise ValueError(f"{name} is in the queue already")
        insort(self._lines.setdefault(line, []), key)
        self.version += 1
        self._of[name] = line, key

    def remove(self, name: str) -> None:
        """Remove a process from any place."""
        line, key = self._of.pop(name)
        self.delayed.discard(name)
        self.awaiting.discard(name)
        keys = self._lines[line]
        del keys[bisect_left(keys, key)]
        if line is not None and not keys:
            del self._lines[line]
        self.version += 1

    @contextmanager
    def without(self, name: str) -> Iterator[None]:
        """Take a process out of the queue, if it is in it, until the end of the block."""
        found = self._of.get(name)
        if found is None:
            yield
            return
        flags = [of for of in (self.delayed, self.awaiting) if name in of]
        self.remove(name)
        try:
            yield
        finally:
            self._add(name, *found)
            for of in flags:
                of.add(name)

    def set_awaiting(self, name: str, *, awaiting: bool) -> None:
        """Note whether a process in the queue waits for something other than its placement."""
        if awaiting != (name in self.awaiting):
            self.awaiting.symmetric_difference_update({name})
            self.version += 1

    def note_places(self, process: Process) -> None:
        """Note that the instances or the array of a process have changed."""
        self.version += self.arrays.note_change(process)

    def __contains__(self, name: str) -> bool:
        return name in self._of

    def __len__(self) -> int:
        return len(self._of)

    def __iter__(self) -> Iterator[str]:
        return (name for _, _, name in list(merge(*self._lines.values())))

    @property
    def has_bounds(self) -> bool:
        """Return True if a job of an array with a bound is in the queue."""
        return len(self._lines) > 1

    def in_turn(self) -> Iterator[str]:
        """Return the names in order, without the jobs of arrays that have no free place.

        Processes may be removed from the queue during the iteration.
        """
        waiting, lines = self._of, [line for line in self._lines if self._is_open(line)]
        keys = self._keys_of(None) if len(lines) == 1 else merge(*map(self._keys_of, lines))
        return (name for _, _, name in keys if name in waiting)

    def head(self) -> str | None:
        """Return the process that is placed next; None: none waits only for its placement."""
        awaiting, lines = self.awaiting, self._lines
        open_ones = [lines[line] for line in lines if line is None or self._is_open(line)]
        if awaiting:
            firsts = (
                next((key for key in keys if key[2] not in awaiting), None) for keys in open_ones
            )
            ready = [key for key in firsts if key is not None]
        else:
            ready = [keys[0] for keys in open_ones if keys]
        return min(ready)[2] if ready else None

    def position(self, name: str) -> int:
        """Return the place of a process; 1: head; 0: not queued, or its array is full."""
        line, key = self._of.get(name, (None, None))
        if key is None or not self._is_open(line):
            return 0
        lines = (keys for one, keys in self._lines.items() if self._is_open(one))
        return 1 + sum(bisect_left(keys, key) for keys in lines)

    def key_of(self, name: str) -> QueueKey:
        """Return the sort key of a queued process."""
        return self._of[name][1]

    def _is_open(self, line: _Line) -> bool:
        return line is None or self.arrays.are_free(*line)

    def _keys_of(self, line: _Line) -> Iterator[QueueKey]:
        keys, at = self._lines[line], 0
        while chunk := keys[at : at + _AT_ONCE]:
            for key in chunk:
                if line is not None and not self._is_open(line):
                    return
                yield key
            at = bisect_right(keys, chunk[-1])
