"""Schedules: jobs that start again, at an interval or at times of day.

A run that is due while the master does not run, or cannot know the end of the former run, follows
once as soon as it can.
"""

from __future__ import annotations

from typing import Final

from rosrm.core.master.checkpoint import images, replication
from rosrm.core.master.master_state import MasterState
from rosrm.core.master.rescheduling import allow_every_host
from rosrm.core.master.state.process import Process, ProcessPhase
from rosrm.model.event_kinds import EventKind
from rosrm.model.values import ProcessSpec
from rosrm.wording import duration, words

#: Seconds after its time from which on a run counts as late.
_LATE: Final = 10.0


def await_first_run(state: MasterState, process: Process, now: float) -> bool:
    """Let a new job wait for its first time of day; return False if it starts at once."""
    if not process.spec.schedule.at:
        return False
    process.next_run = process.spec.schedule.next_run(state.wall)
    state.set_phase(process, ProcessPhase.SCHEDULED, now)
    return True


def change_between_runs(
    state: MasterState, process: Process, spec: ProcessSpec, now: float
) -> None:
    """Replace the spec of a job that waits for its next run; without a schedule it starts now."""
    former, schedule = process.spec.schedule, spec.schedule
    state.set_spec(process, spec)
    if not schedule:
        process.next_run = 0.0
        queue_again(state, process, now)
    elif former.every and schedule.every:  # counted from its last start
        process.next_run += schedule.every - former.every
    elif former != schedule:
        process.next_run = schedule.next_run(state.wall)
    state.save(process)


def review_schedules(state: MasterState, now: float) -> None:
    """Queue each job whose next run is due, or skip the run if the former one has not ended."""
    for name in list(state.scheduled):
        process = state.processes[name]
        if process.next_run > state.wall + process.spec.schedule.longest:  # the clock was set back
            process.next_run = process.spec.schedule.next_run(state.wall)
            state.save(process)
        if 0.0 < process.next_run <= state.wall:
            _review_due(state, process, now)


def _review_due(state: MasterState, process: Process, now: float) -> None:
    if process.phase is ProcessPhase.UNREACHABLE:
        return  # the former run may have ended in time
    if process.phase is not ProcessPhase.SCHEDULED:
        _skip(state, process, now)
    elif not process.instances:
        _begin(state, process, now)


def _begin(state: MasterState, process: Process, now: float) -> None:
    due, late = process.next_run, state.wall - process.next_run
    _advance(state, process)
    queue_again(state, process, now)
    delay = f", {duration(late)} late" if late >= _LATE else ""
    state.record(
        now, EventKind.QUEUED,
        f"{process.name} is queued for its run at {process.spec.schedule.clock(due)}{delay}",
        process=process.name,
    )  # fmt: skip


def _skip(state: MasterState, process: Process, now: float) -> None:
    due = process.spec.schedule.clock(process.next_run)
    _advance(state, process)
    state.record(
        now, EventKind.RUN_SKIPPED,
        f"{process.name}: the run at {due} is skipped, because the former run has not ended (it is "
        f"{words(process.phase.value)})",
        process=process.name,
    )  # fmt: skip
    state.save(process)


def _advance(state: MasterState, process: Process) -> None:
    process.next_run = process.spec.schedule.next_run(state.wall, process.next_run)


def queue_again(state: MasterState, process: Process, now: float) -> None:
    """Queue a process that is terminal, checkpointed or between two runs, as if it were new."""
    images.drop(state, process)
    state.clear_left_behind(process)
    replication.drop_former_replicas(state, process)
    allow_every_host(process)
    process.awaits_gang = bool(process.spec.together)
    process.order = state.next_order
    state.next_order += 1
    state.enqueue(process, now)
    state.save(process)


def why_scheduled(state: MasterState, process: Process) -> str:
    """Return the time of the next run, and the result of the last one."""
    time = process.spec.schedule.describe(process.next_run, state.wall)
    return f"next run {'at ' if process.spec.schedule.at else ''}{time}" + (
        f"; {process.reason}" if process.reason else ""
    )
