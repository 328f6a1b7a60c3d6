"""Failover: a standby replaces its primary.

A standby is the destination of a migration that is paused before the step in which the destination
becomes active. When the primary has ended, `take_over` resumes the migration: that step orders the
destination to take over, and the plan continues as usual, forward or back.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Final

from rosrm.core.master.master_state import MasterState
from rosrm.core.master.state.migration import End, Migration
from rosrm.core.master.state.process import DesiredState, Process, ProcessPhase
from rosrm.model.event_kinds import EventKind
from rosrm.model.plan import Configure, HandoffPhase, ReportPhase, Step

_OVER: Final = frozenset({ReportPhase.FAILED, ReportPhase.ABORTED})


def index_of(phase: HandoffPhase, steps: Sequence[Step]) -> int:
    """Return the index of the step that awaits a phase of a handoff; -1: none."""
    for at, step in enumerate(steps):
        if isinstance(step, Configure) and step.phase is phase and step.awaited:
            return at
    return -1


def is_ready(state: MasterState, process: Process) -> bool:
    """Return True if a process has a standby that could take over now."""
    standby = state.standbys.get(process.name)
    if standby is None or standby.source.number != process.owner:
        return False
    if process.wanted is DesiredState.CANCEL:
        return False
    reported: Mapping[ReportPhase, str] = standby.phases_of(standby.destination)
    instance = state.instances.get(standby.destination.number)
    follows = ReportPhase.READY in reported and not reported.keys() & _OVER
    return follows and instance is not None and not instance.stopping


def take_over(state: MasterState, process: Process, end: End, now: float) -> bool:
    """Let the standby of an ended primary take over.

    Returns:
        False: no standby could take over, or the primary has completed as intended.
    """
    if _succeeded(end) or not is_ready(state, process):
        return False
    migration: Migration = state.standbys.pop(process.name)
    migration.ended[migration.source.number] = end
    migration.index, migration.begun = index_of(HandoffPhase.SWITCH, migration.plan.steps), False
    migration.started, migration.wall = now, state.wall
    migration.cause = f"{migration.source} has ended"
    process.wanted = DesiredState.RUN
    process.left_behind, process.standby_reason = None, ""
    state.migrations[process.name] = migration
    state.set_phase(
        process, ProcessPhase.MIGRATING, now, f"its standby takes over: {migration.cause}"
    )
    state.record(
        now, EventKind.FAILED_OVER,
        f"the standby of {process.name} on {migration.destination_host.name} takes over: "
        f"{migration.cause}"
        + (f" ({end.status.message})" if end.status.message else ""),
        process=process.name, host=migration.destination_host.name,
        facts={"source": migration.source.number, "destination": migration.destination.number},
    )  # fmt: skip
    state.save(process)
    state.save_migration(migration)
    return True


def _succeeded(end: End) -> bool:
    return end.status.succeeded and not end.ordered and not end.gone
