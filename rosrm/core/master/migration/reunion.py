"""Return of a process to the one near which it must run, after something has separated them.

Rules on neighbours hold for every placement and move. Only a lost host, a failed move or a standby
that takes over separates two processes. The master records that, and moves the process that has
the rule to the other one, as soon as the rule can be kept there.
"""

from __future__ import annotations

from typing import Final

from rosrm.core.master.assignment.neighbours import host_of
from rosrm.core.master.master_state import MasterState
from rosrm.core.master.migration.eviction import try_move
from rosrm.core.master.migration.start import moves_under_way
from rosrm.core.master.scheduling.proximity import same_place
from rosrm.core.master.state.process import Process
from rosrm.model.event_kinds import EventKind

#: Shortest time, in seconds, between two attempts to move a process.
_RETRY: Final = 5.0


def review_separated(state: MasterState, now: float) -> None:
    """Record each process that does not run near another one as it must, and move it there."""
    for name in list(state.neighbours.declared):
        process = state.processes[name]
        why = _why_separated(state, process)
        if not why:
            state.neighbours.separated.pop(name, None)
            continue
        before, due = state.neighbours.separated.get(name, ("", now))
        if before != why:
            state.record(now, EventKind.SEPARATED, f"{name}: {why}", process=name)
        if now >= due and _move(state, process, why, now):
            due = now + max(_RETRY, state.settings.cooldown)
        state.neighbours.separated[name] = why, due


def _why_separated(state: MasterState, process: Process) -> str:
    """Return where a process runs instead of near another one; "": it keeps its rules."""
    here, _ = host_of(state, process.name)
    if here is None:
        return ""
    for rule in process.spec.neighbours:
        for name in rule.processes if rule.requires_near else ():
            there, _ = host_of(state, name)
            if there is None or not (there.has_labels or not rule.by):
                continue
            if not same_place(here, there, rule.by):
                return f"it runs on {here.name}, and not near {name}, which runs on {there.name}"
    return ""


def _move(state: MasterState, process: Process, why: str, now: float) -> bool:
    """Try to move a process; return False if no move may begin now."""
    if not state.settings.automatic or moves_under_way(state) >= state.settings.max_migrations:
        return False
    try_move(state, process, why, now)
    return True
