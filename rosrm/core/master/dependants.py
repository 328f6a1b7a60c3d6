"""Effects of a process on its dependants, the processes that start after it: stops and restarts.

A cancelled process is stopped after its cancelled dependants. This order follows from the specs and
the desired states alone, so that it also holds after a restart of the master.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from rosrm.core.master.master_state import MasterState
from rosrm.core.master.rights import may_affect
from rosrm.core.master.state.process import DesiredState, Process
from rosrm.model.dependencies import circle_fault, circle_in, in_order
from rosrm.model.values import EMPTY, ProcessSpec
from rosrm.wording import listed


def note_restart(state: MasterState, process: Process) -> None:
    """Let the dependants that follow a restart restart too, once their conditions hold again."""
    names = state.start_orders.dependants.get(process.name, ())
    if names:
        state.save(process)  # a later master must not take this restart for a new one
    for name in names:
        dependant = state.processes[name]
        if dependant.owner and dependant.spec.start_order.on_restart == "restart":
            dependant.restart_due = True
            state.start_orders.to_review[name] = None
            state.save(dependant)


def dependants_first(state: MasterState, processes: Sequence[Process]) -> list[Process]:
    """Return processes in the order of their stops."""
    named = {process.name: process for process in processes}
    dependants = state.start_orders.dependants
    before = {name: [one for one in dependants.get(name, ()) if one in named] for name in named}
    if not any(before.values()):
        return list(processes)
    return [named[name] for name in in_order(before)]


def orders_from(
    state: MasterState, starting: Sequence[ProcessSpec], mates: Mapping[str, Sequence[str]] = EMPTY
) -> dict[str, Sequence[str]]:
    """Return the dependencies of processes, and of all after which they start.

    Of a process that is not among `starting`, each order that is in force or comes into force
    without a further request counts.

    Args:
        starting: processes with the order that they will have.
        mates: name of a process to those of its gang, which is followed as a whole.
    """
    given, pending = {spec.name: [spec] for spec in starting}, pending_specs(state)
    names, found = list(given), dict[str, Sequence[str]]()
    for name in names:  # they become more
        if name not in found:
            specs = given.get(name) or _specs_of(state, name, pending.get(name))
            found[name] = list(
                dict.fromkeys(one for spec in specs for one in spec.start_order.after)
            )
            names += (*found[name], *mates.get(name, ()))
    return found


def pending_specs(state: MasterState) -> dict[str, ProcessSpec]:
    """Return the specs that unfinished work on applications brings into force, by name."""
    return {
        name: application.specs[name]
        for application in state.applications.values()
        for name in application.tasks
        if name in application.specs
    }


def _specs_of(state: MasterState, name: str, pending: ProcessSpec | None) -> list[ProcessSpec]:
    """Return the specs of a process that are or may be in force; `pending`: that of its task."""
    process = state.processes.get(name)
    is_live = process is not None and not process.phase.is_terminal
    own = (process.spec, state.spec_to_be(process)) if process is not None and is_live else ()
    return [*own, *([pending] if pending is not None else [])]


def circle_from(state: MasterState, starting: Sequence[ProcessSpec]) -> str:
    """Return a sentence on a circle that processes with these start orders close; "": none."""
    circle = circle_in(orders_from(state, starting))
    return circle_fault(circle) if circle else ""


def binding_dependants(state: MasterState, process: Process) -> list[str]:
    """Return the dependants that hold back the stop and the removal of a process.

    Dependants of other users hold back neither, unless an operator submitted them.
    """
    names = state.start_orders.dependants.get(process.name, ())
    return [name for name in names if may_affect(state.processes[name], process)]


def awaited_ends(state: MasterState, process: Process) -> list[str]:
    """Return the names of the processes that must end before a cancelled process is stopped."""
    if process.wanted is not DesiredState.CANCEL or process.killed:
        return []
    dependants = binding_dependants(state, process)
    return [name for name in dependants if state.processes[name].wanted is DesiredState.CANCEL]


def waits_for_ends(state: MasterState, process: Process, now: float) -> bool:
    """Return True if a cancelled process must not be stopped yet; note since when it waits."""
    orders = state.start_orders
    if awaited_ends(state, process):
        orders.last_to_stop.setdefault(process.name, now)
        return True
    if orders.last_to_stop.pop(process.name, None) is not None:
        orders.note_dependant(process.spec.start_order)
    return False


def described_wait(state: MasterState, process: Process) -> str:
    """Return a phrase on the ends for which a cancelled process waits; "": it waits for none."""
    names = awaited_ends(state, process)
    have = "has" if len(names) == 1 else "have"
    return f"; waits until {listed(names)} {have} ended" if names else ""
