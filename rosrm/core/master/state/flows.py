"""Flows between processes that have not ended: declared in their specs, or learned by slaves."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

from rosrm.model.values import EMPTY

#: Two names of processes, in alphabetical order.
Pair = tuple[str, str]


def pair_of(name: str, other: str) -> Pair:
    """Return the pair of two processes."""
    return (name, other) if name < other else (other, name)


class Partner(NamedTuple):
    """A flow between a process and another one.

    Attributes:
        rate: bytes a second, both directions together.
        incoming: the process receives it from the other one, or declares it.
        learned: it was measured, not declared.
    """

    rate: float
    incoming: bool
    learned: bool = False


class Flows:
    """Index of the flows by both of their processes.

    Attributes:
        declared: name of a process to the flows in its spec.
        learned: name of a process to what it receives from others, as its slave measured.
        partners: name of a process to all others with a flow from or to it.
        changed: pairs of processes whose hosts, or flow, may have changed since the last count.
    """

    def __init__(self) -> None:
        self.declared: dict[str, Mapping[str, float]] = {}
        self.learned: dict[str, Mapping[str, float]] = {}
        self.partners: dict[str, dict[str, None]] = {}
        self.changed: dict[Pair, None] = {}

    def declare(self, name: str, flows: Mapping[str, float]) -> None:
        """Set the flows in the spec of a process."""
        self._replace(self.declared, name, flows)

    def learn(self, name: str, flows: Mapping[str, float]) -> None:
        """Set what a process receives from others, as measured."""
        self._replace(self.learned, name, flows)

    def remove(self, name: str) -> None:
        """Remove the flows of a process that has ended; what others declare about it stays."""
        self.declare(name, EMPTY)
        self.learn(name, EMPTY)
        for other in list(self.partners.get(name, ())):
            if name in self.learned.get(other, EMPTY):
                rest = {one: rate for one, rate in self.learned[other].items() if one != name}
                self.learn(other, rest)

    def note_change(self, name: str) -> None:
        """Note that an instance of a process was added or has ended, or owns its name now."""
        for other in self.partners.get(name, ()):
            self.changed[pair_of(name, other)] = None

    def between(self, name: str, other: str) -> Partner:
        """Return the flow between two processes; what a spec declares replaces what was learned."""
        own, theirs = self.declared.get(name, EMPTY), self.declared.get(other, EMPTY)
        if other in own:
            return Partner(own[other], True)
        if name in theirs:
            return Partner(theirs[name], False)
        received = self.learned.get(name, EMPTY).get(other, 0.0)
        sent = self.learned.get(other, EMPTY).get(name, 0.0)
        return Partner(received + sent, received >= sent, True)

    def _replace(
        self, table: dict[str, Mapping[str, float]], name: str, flows: Mapping[str, float]
    ) -> None:
        before = table.get(name, EMPTY)
        if before == flows:
            return
        if flows:
            table[name] = flows
        else:
            del table[name]
        for other in {**before, **flows}:
            self._link(name, other)
            self._link(other, name)
            self.changed[pair_of(name, other)] = None

    def _link(self, name: str, other: str) -> None:
        tables = (self.declared, self.learned)
        if any(other in one.get(name, EMPTY) or name in one.get(other, EMPTY) for one in tables):
            self.partners.setdefault(name, {})[other] = None
        elif other in self.partners.get(name, ()):
            del self.partners[name][other]
            if not self.partners[name]:
                del self.partners[name]
