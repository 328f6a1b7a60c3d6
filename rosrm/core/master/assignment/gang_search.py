"""Search for the hosts of all processes of a gang, by trials that are undone.

A trial adds an instance and its reservation to the state itself. So each filter, neighbour rule and
policy judges the next process exactly as after an assignment. At the end of a search, successful or
not, all trials are undone, and no command was emitted.

The process with the fewest hosts goes first, then the one with the largest needs, which finds a
dead end soon. A host that leaves no place for the rest of the gang is replaced by the next best
one. The number of trials is bounded, because the question is NP-hard (bin packing).
"""

from __future__ import annotations

from collections.abc import Hashable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Final

import numpy as np

from rosrm.core.master.assignment.demands import demand_of, ranking_of
from rosrm.core.master.assignment.neighbours import awaited_neighbour
from rosrm.core.master.master_state import MasterState
from rosrm.core.master.scheduling.feasibility import possible
from rosrm.core.master.state.devices import Inventory
from rosrm.core.master.state.hosts import Host
from rosrm.core.master.state.process import Process
from rosrm.model.devices import HeldDevice
from rosrm.model.values import InstanceId

#: Most processes of one gang.
MOST_MEMBERS: Final = 64
#: Most trials of one search.
_MOST_TRIALS: Final = 200
#: Tolerance in comparisons of sums of fractions.
_CLOSE: Final = 1e-9
_NO_NAMES: Final = frozenset[str]()

#: Processes with the columns of their hosts, in the order of their assignment.
Places = Sequence[tuple[Process, int]]
_Kind = Hashable | None


@dataclass(frozen=True, slots=True)
class Blocked:
    """The outcome of a search that has found no places.

    Attributes:
        process: a process without a host.
        beside: True: it fits on a host, but the search found none beside the others.
        certain: False: the search has used up its trials.
    """

    process: Process
    beside: bool
    certain: bool


class _Search:
    """The search for hosts that can take all processes now."""

    def __init__(self, state: MasterState) -> None:
        self.state = state
        self.places: list[tuple[Process, int]] = []
        self.trials = 0
        self.dead_end: tuple[int, Process] | None = None

    def run(self, members: Sequence[Process]) -> Places | Blocked:
        """Return the places, or why there are none."""
        for process in members:
            awaits = awaited_neighbour(self.state, process, besides=_NO_NAMES)
            if not awaits and not self._columns(process):
                return Blocked(process, beside=False, certain=True)
        if self._place(sorted(members, key=self._rank), frozenset()):
            return self.places
        assert self.dead_end is not None
        return Blocked(self.dead_end[1], beside=True, certain=self.trials < _MOST_TRIALS)

    def _rank(self, process: Process) -> tuple[int, float]:
        """Return the place of a process in the search: fewest hosts, then largest needs."""
        ranking = ranking_of(self.state, demand_of(self.state, process))
        need = ranking.need[np.isfinite(ranking.need)]
        return len(self._columns(process)), -float(need.max(initial=0.0))

    def _place(self, left: Sequence[Process], closed: frozenset[tuple[_Kind, int]]) -> bool:
        """Find places for the rest of the gang.

        `closed`: kind of processes and column of a host where none of this kind leads to a place
        for all; as equal processes are interchangeable, no other one needs a trial there.
        """
        if not left:
            return True
        process = self._next(left)
        rest, kind = [one for one in left if one is not process], self._kind(process)
        for column in self._columns(process):
            if (kind, column) in closed:
                continue
            if self.trials >= _MOST_TRIALS:
                break
            self.trials += 1
            self.places.append((process, column))
            with self._trial(process, column):
                if self._place(rest, closed):
                    return True
            self.places.pop()
            if kind is not None:
                closed |= {(kind, column)}
        depth = len(self.places)
        if self.dead_end is None or depth > self.dead_end[0]:
            self.dead_end = depth, process
        return False

    def _next(self, left: Sequence[Process]) -> Process:
        """Return the first process that waits for no neighbour, which may be one of the gang."""
        return next(
            (
                process for process in left
                if not awaited_neighbour(self.state, process, besides=_NO_NAMES)
            ),
            left[0],
        )  # fmt: skip

    def _kind(self, process: Process) -> _Kind:
        """Return the kind of a process; None: others may be told apart from it by their rules."""
        state, name = self.state, process.name
        if name in state.neighbours.about or name in state.flows.partners:
            return None
        rules = process.spec.neighbours
        alone = demand_of(state, process).key_alone
        return None if any(rule.processes for rule in rules) else (alone, rules)

    def _columns(self, process: Process) -> list[int]:
        """Return the columns of the hosts that can take a process, best first."""
        return ranking_of(self.state, demand_of(self.state, process)).in_order()

    def _devices(self, process: Process, host: Host) -> tuple[HeldDevice, ...]:
        return self.state.hosts.devices[host.column].choose(process.spec.devices) or ()

    @contextmanager
    def _trial(self, process: Process, column: int) -> Iterator[None]:
        """Let a process have an instance on a host until the end of the block."""
        state, host = self.state, self.state.hosts.hosts[column]
        saved = state.hosts.saved(host)
        instance = InstanceId(process.name, -len(self.places))  # no instance has such a number
        demand, devices = demand_of(state, process), self._devices(process, host)
        with state.queue.without(process.name):  # or it is set aside
            state.add_instance(instance, process.spec, host, 0.0, demand, devices=devices)
            process.owner = instance.number
            try:
                yield
            finally:
                process.owner = 0
                state.drop_instance(state.instances[instance.number])
                state.hosts.restore(saved)


class _SearchIfEmpty(_Search):
    """The search for hosts that could take all processes if nothing else ran on any host.

    A host without a reading counts as one with room, because its limits are not known yet.
    """

    def __init__(self, state: MasterState) -> None:
        super().__init__(state)
        table = state.hosts
        self._load = np.zeros_like(table.limit)
        self._number = np.zeros(len(table), np.int64)
        self._inventories: dict[int, Inventory] = {}

    def _columns(self, process: Process) -> list[int]:
        table, demand = self.state.hosts, demand_of(self.state, process)
        need = table.fractions(demand.amounts, demand.estimated)
        over = np.where(np.isinf(need), 0.0, need) + self._load > table.limit + _CLOSE
        has_room = ~np.logical_or.reduce(over) & (self._number < table.bound)
        fits = possible(table, demand) & (has_room | table.without_reading())
        for column, inventory in self._inventories.items():
            if inventory.choose(process.spec.devices) is None:
                fits[column] = False
        emptiest_first = np.argsort(self._load.sum(axis=0), kind="stable")
        return [int(column) for column in emptiest_first if fits[column]]

    def _devices(self, _process: Process, _host: Host) -> tuple[HeldDevice, ...]:
        return ()  # those of the emptied inventories count

    @contextmanager
    def _trial(self, process: Process, column: int) -> Iterator[None]:
        table, demand = self.state.hosts, demand_of(self.state, process)
        need = table.fractions(demand.amounts, demand.estimated)[:, column]
        load, inventory = self._load[:, column].copy(), self._inventory(column)
        held = inventory.choose(process.spec.devices) or ()
        number = InstanceId(process.name, -len(self.places))
        self._inventories[column] = inventory.with_held(number, held)
        self._load[:, column] += np.where(np.isinf(need), 0.0, need)
        self._number[column] += 1
        try:
            with super()._trial(process, column):
                yield
        finally:
            self._number[column] -= 1
            self._load[:, column] = load
            self._inventories[column] = inventory

    def _inventory(self, column: int) -> Inventory:
        return self._inventories.get(column) or self.state.hosts.devices[column].emptied()


def find_places(state: MasterState, members: Sequence[Process]) -> Places | Blocked:
    """Return hosts that can take all of some queued processes now; or why there are none."""
    return _Search(state).run(members)


def find_places_if_empty(state: MasterState, members: Sequence[Process]) -> Places | Blocked:
    """Return hosts that could take all of some waiting processes if nothing else ran there."""
    return _SearchIfEmpty(state).run(members)
