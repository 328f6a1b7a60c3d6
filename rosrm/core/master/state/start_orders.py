"""Index of the start orders of all processes that have not ended, by the named processes.

A dependency is a process after which another one starts, its dependant.
"""

from __future__ import annotations

from math import inf

from rosrm.model.values import ProcessSpec, StartOrder


class StartOrders:
    """Start orders of the processes that have not ended, and the processes to review.

    Attributes:
        declared: name of each process with dependencies to its start order, in order of submission.
        dependants: name of a dependency to its dependants.
        to_review: processes of which a dependency or a dependant has changed, or which have changed
            themselves; in order.
        delayed: process whose conditions hold to the time of the end of its delay.
        last_to_stop: cancelled process that waits for the ends of its dependants to the time since
            when none of them has ended or was ordered to stop; inf: one did since the last review.
    """

    def __init__(self) -> None:
        self.declared: dict[str, StartOrder] = {}
        self.dependants: dict[str, dict[str, None]] = {}
        self.to_review: dict[str, None] = {}
        self.delayed: dict[str, float] = {}
        self.last_to_stop: dict[str, float] = {}

    def add(self, spec: ProcessSpec) -> None:
        """Add the start order of a process, unless it is known."""
        order = spec.start_order
        if self.declared.get(spec.name) is order:
            return
        self.remove(spec.name)
        self.declared[spec.name] = order
        for name in order.after:
            self.dependants.setdefault(name, {})[spec.name] = None

    def remove(self, name: str) -> None:
        """Remove the start order of a process that has ended, if it has any."""
        self.delayed.pop(name, None)
        self.last_to_stop.pop(name, None)
        order = self.declared.pop(name, None)
        if order is None:
            return
        self.note_dependant(order)
        for dependency in order.after:
            del self.dependants[dependency][name]
            if not self.dependants[dependency]:
                del self.dependants[dependency]

    def note_change(self, name: str) -> None:
        """Review a process and its dependants, because its phase has changed."""
        if name in self.declared:
            self.to_review[name] = None
        if name in self.dependants:
            self.to_review.update(self.dependants[name])

    def note_dependant(self, order: StartOrder) -> None:
        """Review the dependencies of a process that has ended or was ordered to stop."""
        for dependency in order.after:
            if dependency in self.last_to_stop:
                self.last_to_stop[dependency] = inf
                self.to_review[dependency] = None

    def take_due(self, now: float) -> list[str]:
        """Return and forget the processes to review; also those whose delay is over."""
        if self.delayed:
            over = [name for name, end in self.delayed.items() if now >= end]
            self.to_review.update(dict.fromkeys(over))
        due = list(self.to_review)
        self.to_review.clear()
        return due

    def set_delay(self, name: str, end: float) -> None:
        """Set the end of the delay of a process; inf: a condition does not hold."""
        if end < inf:
            self.delayed[name] = end
        else:
            self.delayed.pop(name, None)
