"""Failover: a standby replaces its primary.

A standby is the destination of a migration that is paused before its SWITCH step. When the primary
has ended, `take_over` resumes the migration with that step, which orders the standby to become
active. The plan then continues as usual, forward or back.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from rosrm.core.master.master_state import MasterState
from rosrm.core.master.state.migration import End, HandoffReports
from rosrm.core.master.state.process import DesiredState, PendingAmendment, Process, ProcessPhase
from rosrm.model.event_kinds import EventKind
from rosrm.model.plan import Configure, HandoffPhase, ReportPhase, Step

#: Reports of a standby that no longer follows the state of its primary.
_NOT_FOLLOWING: Final = frozenset({ReportPhase.FAILED, ReportPhase.ABORTED})


def index_of(phase: HandoffPhase, steps: Sequence[Step]) -> int:
    """Return the index of the step that awaits a phase of a handoff; -1: none."""
    for at, step in enumerate(steps):
        if isinstance(step, Configure) and step.phase is phase and step.awaited:
            return at
    return -1


def is_ready(state: MasterState, process: Process) -> bool:
    """Return True if a process has a standby that could take over now without loss."""
    reports = _reports_of_standby(state, process)
    return reports is not None and ReportPhase.READY in reports.phases


def can_replace(state: MasterState, process: Process) -> bool:
    """Return True if a standby is ready on a host that reports, so that its primary may be ended.

    Behind the same cut of the network as its primary, or after an unreported end, it is no
    replacement.
    """
    standby = state.standbys.get(process.name)
    reports = standby is not None and state.knows_statuses(standby.destination_host)
    return reports and is_ready(state, process)


def _has_state(state: MasterState, process: Process, end: End) -> bool:
    """Return True if a process that has ended has a standby with its state, ready or not.

    Without its primary such a standby becomes no readier, and each snapshot is older than its
    state. It may still wait for a peer that ended with the primary.

    A standby of a former master that has not reported to this one yet may have a state. If it has
    none, its order to take over times out, and the end of the primary counts as without a standby.
    A restart of the primary that no master has seen would leave it the state of the former run.
    """
    reports = _reports_of_standby(state, process)
    if reports is None or reports.sequence > 0:
        return reports is not None
    is_unheard = not reports.phases and state.standbys[process.name].started <= state.restored_at
    return is_unheard and not end.gone and end.status.restarts == process.restarts


def _reports_of_standby(state: MasterState, process: Process) -> HandoffReports | None:
    """Return the reports of the standby that follows the owner of a process; None: none does."""
    standby = state.standbys.get(process.name)
    if standby is None or standby.source.number != process.owner or standby.source_restarted:
        return None
    if process.wanted is DesiredState.CANCEL:
        return None
    reports = standby.handoff_reports.get(standby.destination.number, HandoffReports())
    instance = state.instances.get(standby.destination.number)
    if instance is None or instance.stopping:
        return None
    return None if reports.phases.keys() & _NOT_FOLLOWING else reports


def note_restart(state: MasterState, process: Process) -> None:
    """Note that a READY standby has only the state of the former run of its primary.

    The master sends no more SHADOW to a READY standby. So the new run may never learn of it, and
    the standby would wait with its old state.
    """
    if is_ready(state, process) and not state.instances[process.owner].stopping:
        state.standbys[process.name].source_restarted = True


def take_over(state: MasterState, process: Process, end: End, now: float) -> bool:
    """Resume the migration of a standby whose primary has ended.

    Returns:
        False: no standby has the state, or the primary has completed as intended.
    """
    succeeded = end.status.succeeded and not end.ordered and not end.gone
    if succeeded or not (is_ready(state, process) or _has_state(state, process, end)):
        return False
    migration = state.standbys.pop(process.name)
    migration.ended[migration.source.number] = end
    migration.index, migration.begun = index_of(HandoffPhase.SWITCH, migration.plan.steps), False
    migration.started, migration.wall = now, state.wall
    migration.cause = f"{migration.source} has ended"
    process.wanted = DesiredState.RUN
    state.clear_left_behind(process)
    process.standby_reason = ""
    # The spec may have changed since the standby was started.
    state.unamended[process.name] = PendingAmendment()
    state.migrations[process.name] = migration
    why, host = migration.cause, migration.destination_host.name
    state.set_phase(process, ProcessPhase.MIGRATING, now, f"its standby takes over: {why}")
    details = f" ({end.status.message})" if end.status.message else ""
    state.record(
        now, EventKind.FAILED_OVER,
        f"the standby of {process.name} on {host} takes over: {why}{details}",
        process=process.name, host=host,
        facts={"source": migration.source.number, "destination": migration.destination.number},
    )  # fmt: skip
    state.save(process)
    state.save_migration(migration)
    return True
