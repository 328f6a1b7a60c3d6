"""Room on hosts: the load of single instances, and trials of moves that have not begun."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Final

import numpy as np

from rosrm.core.master.assignment.assign import demand_amounts, measured_need
from rosrm.core.master.master_state import MasterState
from rosrm.core.master.migration.eviction import PlannedMoves
from rosrm.core.master.migration.start import why_cooling_down, why_immovable
from rosrm.core.master.state.host_arrays import BoolArray, FloatArray
from rosrm.core.master.state.hosts import SavedColumn
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


@contextmanager
def trial(state: MasterState) -> Iterator[Callable[[PlannedMoves], None]]:
    """Yield a function that reserves the room of planned moves until the end of the block.

    The devices of the moves are a part of their room.
    """
    table = state.hosts
    before: dict[int, SavedColumn] = {}

    def reserve(planned: PlannedMoves) -> None:
        host = planned.destination
        column = host.column
        if column not in before:
            before[column] = table.saved(host)
        for process, _, own, _ in planned.steps:
            held = table.devices[column].choose(own.demand.spec.devices)
            table.hold(host, InstanceId(process.name, 0), held or ())
            table.add_reservation(host, own.need[:, column], processes=1)

    try:
        yield reserve
    finally:
        for saved in before.values():
            table.restore(saved)
