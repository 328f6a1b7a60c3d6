"""Deadlines of processes that wait for a host, after which the version of their application fails.

A service must start, so its wait is bounded by `applications.progress_deadline`. A job may wait
long. So may a process whose dependencies have not started, and one whose host is out of reach.
"""

from __future__ import annotations

from math import inf

from rosrm.core.master.assignment.gangs import members_of
from rosrm.core.master.assignment.places import array_without_place
from rosrm.core.master.master_state import MasterState
from rosrm.core.master.state.applications import Application, Task
from rosrm.core.master.state.process import WAITING, Process, ProcessPhase
from rosrm.model.values import Kind, ProcessSpec
from rosrm.wording import duration


def awaits_host(state: MasterState, process: Process) -> bool:
    """Return True if a process waits for a host, and for no other process."""
    if process.phase not in WAITING:
        return False
    gang = members_of(state, process)
    if process.name in state.queue and array_without_place(state, process) is not None:
        return False
    return not any(one.name in state.queue.awaiting for one in gang)


def note_wait(
    state: MasterState, application: Application, task: Task, spec: ProcessSpec, now: float
) -> None:
    """Note since when a service waits for a host; the deadline is a fault of its task."""
    deadline = state.settings.progress_deadline
    if not task.awaits_host or spec.kind is Kind.JOB or not deadline:
        task.awaits_since = inf
        return
    task.awaits_since = min(task.awaits_since, now)
    if now - task.awaits_since >= deadline:
        task.fault = f"it has waited {duration(deadline)} for a host: {task.reason}"
    else:
        follows = _what_follows(application)
        task.reason += f"; if this lasts {duration(deadline)}, {follows}"


def _what_follows(application: Application) -> str:
    version = application.version
    if version is None or not application.former:
        return "the application is degraded"
    if version.rollout.on_failure == "pause":
        return "the application is paused"
    return f"version {application.former} returns"


def is_set_aside_for_good(
    state: MasterState, application: Application, task: Task, process: Process, now: float
) -> bool:
    """Return True if a process that no known host may take is a fault.

    A first version has none to return to, and the hosts of a new cluster register one by one.
    """
    if process.phase is not ProcessPhase.SET_ASIDE:
        return False
    if application.former:
        return task.replaces
    settings = state.settings
    return bool(settings.progress_deadline) and _waited(state, process, now) >= settings.lease


def has_waited_too_long(state: MasterState, process: Process, since: float, now: float) -> bool:
    """Return True if the wait of a process for a host since a time is longer than it may be."""
    deadline = state.settings.progress_deadline
    if not deadline or process.spec.kind is Kind.JOB or not awaits_host(state, process):
        return False
    return min(now - since, _waited(state, process, now)) >= deadline


def _waited(state: MasterState, process: Process, now: float) -> float:
    """Return the seconds of a wait that this master has seen.

    The time before comes from the journal as unix time, and the clock may have been set since.
    """
    return now - max(process.since, state.restored_at)
