"""Room on hosts: the load of single instances, and trials of moves that have not begun."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import Final

import numpy as np

from rosrm.core.master.assignment.assign import demand_amounts, measured_need
from rosrm.core.master.master_state import MasterState
from rosrm.core.master.migration.eviction import PlannedMoves
from rosrm.core.master.migration.start import why_cooling_down, why_immovable
from rosrm.core.master.state.host_arrays import BoolArray, FloatArray
from rosrm.core.master.state.hosts import Host, SavedColumn
from rosrm.core.master.state.process import Instance, Process
from rosrm.model.plan import Aim
from rosrm.model.values import InstanceId

#: Tolerance in comparisons of sums of fractions.
CLOSE: Final = 1e-9


def share_of(state: MasterState, instance: Instance) -> FloatArray:
    """Return the fractions, (R,), of its host that an instance uses, or that are reserved for it.

    It is the part of `HostColumns.busy` that its end frees.
    """
    host, table = instance.host, state.hosts
    shared = host.shared if instance.shown else frozenset[str]()
    declared = {name: much for name, much in instance.demand.items() if name in shared}
    share = table.fractions_of(host, {**instance.measured, **declared})
    share[np.isinf(share)] = 0.0
    share[: len(instance.reserved)] += instance.reserved
    return share


def is_leaving(state: MasterState, instance: Instance) -> bool:
    """Return True if an instance is being stopped, or is the source of a move that goes forward."""
    migration = state.migrations.get(instance.id.process)
    moves = (
        migration is not None
        and migration.source == instance.id
        and migration.aim is Aim.MOVE
        and migration.undo is None
        and not migration.stuck
    )
    return moves or instance.stopping


def why_it_cannot_move(state: MasterState, process: Process, now: float) -> str:
    """Return why a running process cannot move to make the load of hosts better; "": it may."""
    return (
        why_cooling_down(state, process, now)
        or why_immovable(state, process)
        or _why_no_room(state, process)
    )


def _why_no_room(state: MasterState, process: Process) -> str:
    """Return why no other host has room for a running process; "": one may have.

    It is a quick check of the largest part of all refusals, before a move is planned.
    """
    table, owner = state.hosts, state.instances[process.owner]
    need = table.fractions(*demand_amounts(state, process, measured_need(state, owner.measured)))
    limit = table.limit - state.settings.headroom + CLOSE
    full: BoolArray = np.logical_or.reduce(table.busy + need > limit)
    full[owner.host.column] = True
    return f"no host has room for {process.name}" if full.all() else ""


class Trial:
    """Changes of the room on hosts that `trial` undoes.

    Attributes:
        freed: numbers of the instances whose room counts as free.
    """

    def __init__(self, state: MasterState) -> None:
        self.freed = set[int]()
        self._state, self._table = state, state.hosts
        self._before: dict[int, tuple[SavedColumn, bool]] = {}

    def reserve(self, planned: PlannedMoves) -> None:
        """Reserve the room of planned moves, with their devices."""
        host, table = planned.destination, self._table
        self._save(host)
        for process, _, own, _ in planned.steps:
            held = table.devices[host.column].choose(own.demand.spec.devices)
            table.hold(host, InstanceId(process.name, 0), held or ())
            table.add_reservation(host, own.need[:, host.column], processes=1)

    def free(self, instances: Iterable[Instance]) -> None:
        """Free the room of instances, as their ends do once the readings show them."""
        for one in instances:
            host, table = one.host, self._table
            self._save(host)
            self.freed.add(one.id.number)
            table.hold(host, one.id, ())
            table.free(host, share_of(self._state, one))

    def _save(self, host: Host) -> None:
        table = self._table
        if host.column not in self._before:
            self._before[host.column] = table.saved(host), bool(table.accepting[host.column])

    def undo(self) -> None:
        """Undo all changes."""
        for saved, accepting in self._before.values():
            self._table.restore(saved)
            self._table.set_accepting(saved.column, accepting=accepting)


@contextmanager
def trial(state: MasterState) -> Iterator[Trial]:
    """Yield a trial, which is undone at the end of the block."""
    tried = Trial(state)
    try:
        yield tried
    finally:
        tried.undo()
