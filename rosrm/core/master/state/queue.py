"""Queue of waiting processes: first in, first out, within a priority."""

from __future__ import annotations

from bisect import bisect_left, insort
from collections.abc import Iterator
from contextlib import contextmanager

from rosrm.core.master.state.arrays import ArrayPlaces

_Key = tuple[int, int, str]


class Queue:
    """Names of waiting processes in the order of their placement.

    Attributes:
        version: counter of changes.
        delayed: names in it that wait for the end of their delay.
        arrays: jobs that wait outside of it, because their array has no place for them.
        awaiting: names in it that wait for other processes, or for an answer of their strategy.
    """

    def __init__(self) -> None:
        self.version = 0
        self.delayed: set[str] = set()
        self.arrays = ArrayPlaces()
        self.awaiting: set[str] = set()
        self._keys: list[_Key] = []
        self._of: dict[str, _Key] = {}

    def add(self, name: str, priority: int, order: int) -> None:
        """Queue a process; a process that returns with its old `order` gets its old place."""
        if name in self._of:
            raise ValueError(f"{name} is in the queue already")
        key = (-priority, order, name)
        insort(self._keys, key)
        self.version += 1
        self._of[name] = key

    def remove(self, name: str) -> None:
        """Remove a process from any place."""
        key = self._of.pop(name)
        self.delayed.discard(name)
        self.awaiting.discard(name)
        del self._keys[bisect_left(self._keys, key)]
        self.version += 1

    @contextmanager
    def without(self, name: str) -> Iterator[None]:
        """Take a process out of the queue, if it is in it, until the end of the block."""
        key = self._of.get(name)
        if key is None:
            yield
            return
        flags = [of for of in (self.delayed, self.awaiting) if name in of]
        self.remove(name)
        try:
            yield
        finally:
            self.add(name, -key[0], key[1])
            for of in flags:
                of.add(name)

    def set_awaiting(self, name: str, *, awaiting: bool) -> None:
        """Note whether a process in the queue waits for something other than its placement."""
        if awaiting != (name in self.awaiting):
            self.awaiting.symmetric_difference_update({name})
            self.version += 1

    def __contains__(self, name: str) -> bool:
        return name in self._of

    def __len__(self) -> int:
        return len(self._keys)

    def __iter__(self) -> Iterator[str]:
        return (name for _, _, name in list(self._keys))

    def head(self) -> str | None:
        """Return the process that is placed next; None: none waits only for its placement."""
        if self.awaiting:
            return next((name for _, _, name in self._keys if name not in self.awaiting), None)
        return self._keys[0][2] if self._keys else None

    def position(self, name: str) -> int:
        """Return the place of a process; 1: head; 0: not in the queue."""
        key = self._of.get(name)
        return 0 if key is None else bisect_left(self._keys, key) + 1
