"""Flows between processes that have not ended: declared in their specs, or learned by slaves."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final, NamedTuple

from rosrm.model.values import EMPTY

#: Seconds after which a learned flow that is not measured any more stops counting. A slave that
#: starts again needs minutes to measure all flows, and some topics have messages seldom.
LEARNED_FOR: Final = 600.0
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
        self._measured_at: dict[str, dict[str, float]] = {}
        self.partners: dict[str, dict[str, None]] = {}
        self.changed: dict[Pair, None] = {}

    def declare(self, name: str, flows: Mapping[str, float]) -> None:
        """Set the flows in the spec of a process."""
        self._replace(self.declared, name, flows)

    def learn(self, name: str, flows: Mapping[str, float], now: float, since: float) -> None:
        """Set what a process receives from others, as measured now.

        A flow that was not measured for LEARNED_FOR stops counting; other flows stay.

        Args:
            since: time of the assignment of its instance; before, its slave could not measure.
        """
        at = self._measured_at.setdefault(name, {})
        at |= dict.fromkeys(flows, now)
        known = self.learned.get(name, EMPTY)
        rest = {one: rate for one, rate in known.items() if now - max(at[one], since) < LEARNED_FOR}
        self._set_learned(name, {**rest, **flows})

    def remove(self, name: str) -> None:
        """Remove the flows of a process that has ended; what others declare about it stays."""
        if name not in self.partners:
            return
        self.declare(name, EMPTY)
        self._set_learned(name, EMPTY)
        for other in list(self.partners.get(name, ())):
            if name in self.learned.get(other, EMPTY):
                rest = {one: rate for one, rate in self.learned[other].items() if one != name}
                self._set_learned(other, rest)

    def note_change(self, name: str) -> None:
        """Note that an instance of a process was added or has ended, or owns its name now."""
        for other in self.partners.get(name, ()):
            self.changed[pair_of(name, other)] = None

    def between(self, name: str, other: str, *, bound: bool = True) -> Partner:
        """Return the flow between two processes.

        What a spec declares replaces what was learned. If both declare a rate, the greater counts.

        Args:
            bound: False ignores what the other process declares.
        """
        own = self.declared.get(name, EMPTY).get(other)
        theirs = self.declared.get(other, EMPTY).get(name) if bound else None
        if own is not None and own >= (theirs or 0.0):
            return Partner(own, True)
        if theirs is not None:
            return Partner(theirs, False)
        received = self.learned.get(name, EMPTY).get(other, 0.0)
        sent = self.learned.get(other, EMPTY).get(name, 0.0)
        return Partner(received + sent, received >= sent, True)

    def _set_learned(self, name: str, flows: Mapping[str, float]) -> None:
        self._replace(self.learned, name, flows)
        at = self._measured_at.pop(name, EMPTY)
        if flows:
            self._measured_at[name] = {one: at[one] for one in flows}

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
