"""Time limits of jobs: a job that runs for too long is stopped, and has failed."""

from __future__ import annotations

from rosrm.core.master import lifecycle
from rosrm.core.master.master_state import MasterState
from rosrm.core.master.state.process import DesiredState, Process
from rosrm.model.event_kinds import EventKind
from rosrm.model.plan import Aim


def review_time_limits(state: MasterState, now: float) -> None:
    """Stop each job that runs longer than its time limit."""
    for name in list(state.time_limited):
        process = state.processes[name]
        if _is_overdue(process, now) and _may_stop(state, process):
            _stop(state, process, now)


def _is_overdue(process: Process, now: float) -> bool:
    return now - process.started_at >= process.spec.time_limit


def _may_stop(state: MasterState, process: Process) -> bool:
    """Return True unless the job is being stopped, checkpointed or restored."""
    migration = state.migrations.get(process.name)
    if migration is not None:
        return migration.aim is Aim.MOVE and process.wanted is DesiredState.RUN
    return process.owner in state.instances and process.wanted is DesiredState.RUN


def _stop(state: MasterState, process: Process, now: float) -> None:
    process.wanted, process.overdue = DesiredState.CANCEL, True
    state.record(
        now, EventKind.OVERDUE,
        f"{process.name} is stopped: its time limit of {process.spec.time_limit:g} s has passed",
        process=process.name,
    )  # fmt: skip
    if process.name not in state.migrations:  # otherwise the plan is undone first
        owner = state.instances[process.owner]
        lifecycle.note_phase(state, process, owner, now)
        lifecycle.stop_instance(state, owner, now)
    state.save(process)
