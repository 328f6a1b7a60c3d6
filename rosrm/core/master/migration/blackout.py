"""Blackout of a migration: the time in which neither its source nor its destination is active.

The blackout begins with the first step that changes the source (a stop, a deactivation or a freeze,
which have an undo), or with the report of a handoff that the source is silent. The blackout ends
with the commit, which follows an active destination; with the report of a handoff that the
destination is active; or with the last step on the destination after the commit, by which a
restored process joins the ROS graph again.
"""

from __future__ import annotations

from rosrm.core.master.state.migration import Migration
from rosrm.model.plan import Aim, Commit, Execute, ReportPhase, SetLifecycle, Step, Stop


def note_begun(migration: Migration, step: Step, now: float) -> None:
    """Note the beginning of a step; may be called again for a step."""
    is_new = migration.silent_at is None and migration.undo is None and not migration.committed
    if is_new and changes_source(migration, step):
        migration.silent_at = now


def changes_source(migration: Migration, step: Step) -> bool:
    """Return True if a step of the plan may stop, deactivate or freeze the source."""
    if step.undo is None:
        return False
    if isinstance(step, Execute):
        return step.host == migration.source_host.name
    return isinstance(step, Stop | SetLifecycle) and step.instance == migration.source


def note_done(migration: Migration, step: Step, now: float) -> None:
    """Note the end of a step."""
    if isinstance(step, Execute):
        is_end = migration.committed and step.host == migration.destination_host.name
    else:
        is_end = isinstance(step, Commit) and migration.active_at is None
    if is_end:
        migration.active_at = now


def note_reported(migration: Migration, phase: ReportPhase, now: float) -> None:
    """Note a report of a node in a handoff."""
    if phase is ReportPhase.SILENT:
        migration.silent_at = now
    elif phase is ReportPhase.ACTIVE:
        migration.active_at = now


def seconds(migration: Migration) -> float | None:
    """Return the blackout of a finished move; None: this master has not seen all of it."""
    is_whole = migration.is_timed and not migration.taking_over and migration.undo is None
    if not is_whole or migration.aim is not Aim.MOVE or migration.active_at is None:
        return None
    return (
        0.0 if migration.silent_at is None else max(0.0, migration.active_at - migration.silent_at)
    )
