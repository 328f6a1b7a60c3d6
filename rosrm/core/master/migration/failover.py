"""Failover: a standby replaces its primary.

A standby is the destination of a migration that is paused before the step in which the destination
becomes active. When the primary has ended, `take_over` resumes the migration: that step orders the
destination to take over, and the plan continues as usual, forward or back.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Final

from rosrm.core.master.master_state import MasterState
from rosrm.core.master.state.migration import End, Run
from rosrm.core.master.state.process import Process, ProcessPhase, Wanted
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
    if process.wanted is Wanted.CANCEL:
        return False
    said: Mapping[ReportPhase, str] = standby.phases_of(standby.destination)
    instance = state.instances.get(standby.destination.number)
    follows = ReportPhase.READY in said and not said.keys() & _OVER
    return follows and instance is not None and not instance.stopping


def take_over(state: MasterState, process: Process, end: End, now: float) -> bool:
    """Let the standby of an ended primary take over.

    Returns:
        False: no standby could take over, or the primary has completed as intended.
    """
    if _succeeded(end) or not is_ready(state, process):
        return False
    run: Run = state.standbys.pop(process.name)
    run.ended[run.source.number] = end
    run.index, run.begun = index_of(HandoffPhase.SWITCH, run.plan.steps), False
    run.started, run.wall = now, state.wall
    run.cause = f"{run.source} has ended"
    process.wanted = Wanted.RUN
    process.left_behind, process.standby_reason = None, ""
    state.runs[process.name] = run
    state.set_phase(process, ProcessPhase.MIGRATING, now, f"its standby takes over: {run.cause}")
    state.record(
        now, EventKind.FAILED_OVER,
        f"the standby of {process.name} on {run.destination_host.name} takes over: {run.cause}"
        + (f" ({end.status.message})" if end.status.message else ""),
        process=process.name, host=run.destination_host.name,
        facts={"source": run.source.number, "destination": run.destination.number},
    )  # fmt: skip
    state.save(process)
    state.save_run(run)
    return True


def _succeeded(end: End) -> bool:
    return end.status.succeeded and not end.ordered and not end.gone
