"""Work on an application until all its processes are as desired.

The tasks of an application name the processes that are not as desired. Each review looks at the
state of such a process, and takes the next step towards the desired spec:

==========================  ==================================================================
process                     step
==========================  ==================================================================
is not desired              cancel it; the task ends when the process has ended
does not exist, has ended   add it to the queue; the task ends when the process runs well
differs in place            change its spec; its slave changes the running instance
waits in the queue          replace its spec
waits for its next run      replace its spec
runs, and can be replaced   migrate it to an instance of the new spec
runs, and cannot            stop it; its next start has the new spec
is in transition            wait
==========================  ==================================================================

A step that fails leads back to the former version of the application, unless there is none. Then a
process that runs with another version is replaced later; the wait doubles with each failure.
"""

from __future__ import annotations

from collections.abc import Mapping
from collections.abc import Set as AbstractSet
from dataclasses import replace
from functools import partial
from math import inf
from typing import Final

from rosrm.core.master.applications.deadlines import (
    awaits_host,
    is_set_aside_for_good,
    note_wait,
)
from rosrm.core.master.applications.difference import differences, with_changes_in_place
from rosrm.core.master.applications.listing import described, unwell_processes
from rosrm.core.master.applications.replacement import Busy, NeverFits, try_replace
from rosrm.core.master.assignment.assign import reconsider_set_aside
from rosrm.core.master.assignment.gangs import gang_fault
from rosrm.core.master.cancellation import cancel
from rosrm.core.master.contradictions import neighbour_fault
from rosrm.core.master.dependants import circle_from, dependants_first
from rosrm.core.master.master_state import MasterState
from rosrm.core.master.requests import add_process, still_stopping
from rosrm.core.master.schedules import change_between_runs
from rosrm.core.master.start_order import dependants_fault, start_order_fault
from rosrm.core.master.state.applications import Application, Task
from rosrm.core.master.state.backoff import Backoff
from rosrm.core.master.state.process import (
    WAITING,
    DesiredState,
    PendingAmendment,
    Process,
    ProcessPhase,
)
from rosrm.model.applications import Action
from rosrm.model.event_kinds import EventKind
from rosrm.model.requester import Requester
from rosrm.model.values import EMPTY, Kind, ProcessSpec
from rosrm.wording import counted

#: Phases of a process that runs in any way that its slave reports.
_STARTED: Final = (
    ProcessPhase.ASSIGNED, ProcessPhase.STARTING, ProcessPhase.RUNNING, ProcessPhase.BACKOFF,
)  # fmt: skip
#: First and longest time, in seconds, until a replacement that has failed is tried again.
_WAITS: Final = (30.0, 600.0)


def review(state: MasterState, now: float) -> None:
    """Take the next steps of all applications that are not as desired."""
    for application in list(state.applications.values()):
        if application.behind:
            _try_again(state, application, now)
        if application.tasks and not application.paused:
            _review(state, application, now)


def _try_again(state: MasterState, application: Application, now: float) -> None:
    """Replace the processes again whose replacement has failed long enough ago."""
    for name, backoff in list(application.behind.items()):
        if not _is_behind(state, application, name):
            del application.behind[name]
            state.save_application(application)
        elif name not in application.tasks and now >= backoff.until:
            application.reopen(name)


def _is_behind(state: MasterState, application: Application, name: str) -> bool:
    """Return True if a process that is to run runs with another version than the desired one."""
    process, spec = state.processes.get(name), application.specs.get(name)
    if process is None or spec is None or process.spec.application != application.name:
        return False
    is_live = not process.phase.is_terminal and process.wanted is not DesiredState.CANCEL
    return is_live and state.spec_to_be(process) != spec


def _review(state: MasterState, application: Application, now: float) -> None:
    version = application.version
    most = inf if version is None else version.rollout.max_parallel
    replacing = sum(_is_replaced(state, name, task) for name, task in application.tasks.items())
    for name, task in list(application.tasks.items()):
        spec, was_replaced = application.specs.get(name), _is_replaced(state, name, task)
        if spec is None:
            done = _stop(state, application, name, now)
        else:
            task.awaits_host = False
            done = not task.fault and _advance(
                state, application, task, spec, now, may_replace=replacing < most
            )
            note_wait(state, application, task, spec, now)
            replacing += _is_replaced(state, name, task) and not was_replaced
        if done:
            _end(state, application, name)
        elif task.fault:
            _handle_fault(state, application, name, task, now)
            return  # the tasks may be others now
    if not application.tasks:
        _note_end(state, application, now)


def _is_replaced(state: MasterState, name: str, task: Task) -> bool:
    """Return True if a live process is being replaced, by this version or still by another one."""
    process = state.processes.get(name)
    by_other = process is not None and state.replacement_of(process) is not None
    return by_other or (task.begun and task.replaces)


def _end(state: MasterState, application: Application, name: str) -> None:
    del application.tasks[name]
    application.behind.pop(name, None)
    state.save_application(application)


# --- one process ------------------------------------------------------------------------------


def _stop(state: MasterState, application: Application, name: str, now: float) -> bool:
    """Cancel a process that is not desired any more; return True if it has ended."""
    process = state.processes.get(name)
    if process is None or process.spec.application != application.name:
        return True
    if not process.phase.is_terminal and process.wanted is not DesiredState.CANCEL:
        cancel(state, process, now, by=Requester(application.principal))
    return process.phase.is_terminal and not state.may_run(process)


def _advance(
    state: MasterState, application: Application, task: Task, spec: ProcessSpec, now: float,
    *, may_replace: bool,
) -> bool:  # fmt: skip
    """Take the next step for one desired process; return True if the process is as desired."""
    process = state.processes.get(spec.name)
    task.reason = _why_not_own(application, process)
    if task.reason:
        return False
    if process is None or process.phase.is_terminal:
        return _advance_ended(state, application, task, process, spec, now)
    if process.wanted is DesiredState.CANCEL:
        task.reason = "waits until its former instance has ended"
        return False
    _change_in_place(state, process, spec, now)
    if spec == state.spec_to_be(process):
        return process.next_spec is None and _runs_well(state, application, task, process, now)
    if process.phase is ProcessPhase.SCHEDULED and (task.begun or may_replace):
        _replace(state, application, task, process, spec, now)
    elif task.begun and process.name not in state.migrations:
        task.fault = "its new version did not start"
    # A process in back-off does not run: its replacement interrupts nothing.
    elif not task.begun and (may_replace or process.phase is ProcessPhase.BACKOFF):
        _replace(state, application, task, process, spec, now)
    elif not task.begun:
        task.reason = "waits until other processes are replaced"
    return False


def _advance_ended(
    state: MasterState, application: Application, task: Task, process: Process | None,
    spec: ProcessSpec, now: float,
) -> bool:  # fmt: skip
    """Start a process that does not run; if this was done before, judge its end."""
    task.reason = still_stopping(state, spec.name)
    if process is not None and state.may_run(process):
        task.reason = task.reason or "waits until its standby has ended"
    if task.reason:
        return False
    if task.begun and _has_ended(process, spec):
        if process is not None and process.phase is ProcessPhase.FAILED:
            task.fault = f"it failed: {process.reason}"
        elif process is not None and process.phase is ProcessPhase.FINISHED:
            task.fault = "" if process.is_finished_job else "it has finished, but is a service"
        return not task.fault
    _begin(state, application, task)
    version = application.version
    defaulted = version.defaulted.get(spec.name, ()) if version is not None else ()
    owner = Requester(application.principal, is_operator=application.by_operator)
    add_process(state, spec, defaulted, owner, now)
    return False


def _why_not_own(application: Application, process: Process | None) -> str:
    """Return why a name cannot be used for now; "" if it can."""
    if process is None:
        return ""
    if process.principal != application.principal:
        return "waits until the process of this name, which is another user's, is removed"
    if process.spec.application != application.name and not process.phase.is_terminal:
        other = process.spec.application
        whose = f"of the application {other}" if other else "a single process"
        return f"waits until the process of this name, which is {whose}, has ended"
    return ""


def _has_ended(process: Process | None, spec: ProcessSpec) -> bool:
    """Return True if the action on a process has had its effect, and the process has ended since.

    A process that somebody has cancelled or removed in between does not start again.
    """
    if process is None or process.phase is ProcessPhase.CANCELLED:
        return True
    return process.spec == spec


def _begin(state: MasterState, application: Application, task: Task) -> None:
    task.begun = True
    state.save_application(application)


def _change_in_place(state: MasterState, process: Process, spec: ProcessSpec, now: float) -> None:
    """Apply those changes of a spec that need no new start."""
    before = process.spec
    changed = with_changes_in_place(state, process, spec)
    if changed == before:
        return
    state.amend_spec(process, changed)
    if (changed.restart, changed.limits) != (before.restart, before.limits) and process.owner:
        pending = state.unamended.get(process.name)
        limits = changed.limits != before.limits or (pending is not None and pending.limits)
        state.unamended[process.name] = PendingAmendment(limits)
    if process.phase is ProcessPhase.SET_ASIDE:
        reconsider_set_aside(state, now)


def _replace(
    state: MasterState, application: Application, task: Task, process: Process, spec: ProcessSpec,
    now: float,
) -> None:  # fmt: skip
    """Begin to replace a process whose spec needs a new start."""
    if process.phase in WAITING:
        state.unqueue(process)
        process.next_spec = spec
        state.enqueue(process, now)
    elif process.phase is ProcessPhase.SCHEDULED:
        change_between_runs(state, process, spec, now)
    elif process.next_spec is not None:  # it is being stopped, to start with another spec
        process.next_spec = spec
        state.save(process)
    elif process.phase in _STARTED and process.wanted is DesiredState.RUN:
        cause = f"version {application.wanted} of {application.name}"
        refusal = try_replace(state, process, spec, cause, now)
        if isinstance(refusal, NeverFits):
            task.fault = refusal.reason
        if refusal is not None:
            task.reason, task.awaits_host = refusal.reason, not isinstance(refusal, Busy)
            return
    else:
        task.reason = process.reason or f"it is {process.phase.value}"
        return
    task.reason = ""
    _begin(state, application, task)


def _runs_well(
    state: MasterState, application: Application, task: Task, process: Process, now: float
) -> bool:
    """Return True if a process with the desired spec has run well for long enough."""
    if not task.begun:  # it was only changed in place
        task.reason = "waits until its slave has changed it"
        is_replaced = state.replacement_of(process) is not None
        return not is_replaced and process.name not in state.unamended
    task.reason = process.reason or f"it is {process.phase.value}"
    run, is_running = (process.owner, process.restarts), process.phase is ProcessPhase.RUNNING
    task.awaits_host = awaits_host(state, process)
    if is_set_aside_for_good(state, application, task, process, now):
        task.fault = f"it is set aside: {process.reason}"
    elif process.phase is ProcessPhase.BACKOFF or (run[0] == task.run[0] and run != task.run):
        why = process.reason.partition("; restart ")[0] or "it was restarted"
        task.fault = f"it does not run well: {why}"
    elif process.phase is ProcessPhase.SCHEDULED:
        return True
    elif is_running and process.name not in state.migrations:
        if task.run != run:
            task.run, task.well_since = run, now
        return _has_lasted(state, application, task, process, now)
    return False


def _has_lasted(
    state: MasterState, application: Application, task: Task, process: Process, now: float
) -> bool:  # fmt: skip
    """Return True if a running process has run for long enough, as its host confirms."""
    version, owner = application.version, state.owner_of(process)
    lasts = 0.0 if version is None or not application.former else version.rollout.healthy_for
    task.reason = f"must run for {lasts:g} s without a restart"
    if process.spec.kind is Kind.JOB or owner is None:
        return True
    return now - task.well_since >= lasts and state.knows_statuses(owner.host)


# --- faults and the end -----------------------------------------------------------------------


def _handle_fault(
    state: MasterState, application: Application, name: str, task: Task, now: float
) -> None:
    """Return to the former version, or pause; without one, end the task."""
    version, why = application.version, f"{name}: {task.fault}"
    if version is None or not application.former:
        behind = application.behind.get(name, Backoff())
        _end(state, application, name)
        application.returning = application.returning and bool(application.tasks)
        if _is_behind(state, application, name):
            behind.note(now, *_WAITS)
            application.behind[name] = behind
        _note(state, application, now, EventKind.APPLICATION_FAILED, f"is degraded: {why}")
        return
    cancelled = frozenset(filter(partial(_stays_cancelled, state, application), version.specs))
    pauses = version.rollout.on_failure == "pause"
    fault = "" if pauses else _fault_of_return(state, application, cancelled)
    if pauses or fault:
        why += fault and f"; the former version {application.former} does not return: {fault}"
        application.paused = why
        _note(state, application, now, EventKind.APPLICATION_FAILED, f"is paused: {why}")
    else:
        message = f"returns from version {version.number} to {application.former}: {why}"
        _note(state, application, now, EventKind.APPLICATION_RETURNS, message)
        state.save_version(application, replace(version, given_up=why))
        _set_wanted(state, application, application.former, now, former=0, stay_cancelled=cancelled)


def _fault_of_return(
    state: MasterState, application: Application, stay_cancelled: AbstractSet[str]
) -> str:
    """Return why the former version could never start; "": it may.

    Other applications may have changed since that version was checked.
    """
    former = application.versions.get(application.former)
    given = former.specs.values() if former is not None else ()
    specs = {spec.name: spec for spec in given if spec.name not in stay_cancelled}
    found = differences(state, application.name, specs, ())
    waiting = {
        name for name, spec in specs.items()
        if (name in found and found[name].action is Action.START)
        or (name in state.processes and state.processes[name].phase in WAITING)
    }  # fmt: skip
    starting = waiting | {name for name in found if found[name].action is Action.REPLACE}
    joining = {
        name: (application.principal, specs[name].together)
        for name in waiting if specs[name].together
    }  # fmt: skip
    coming, leaving = list(specs.values()), application.specs.keys() - specs.keys()
    return (
        neighbour_fault(state, coming, application.principal)
        or start_order_fault(state, [specs[name] for name in specs if name in starting])
        or circle_from(state, coming)
        or dependants_fault(state, coming, application.principal)
        or gang_fault(state, coming, joining, leaving)
    )


def _is_cancelled(state: MasterState, name: str) -> bool:
    """Return True if a process has been cancelled, or is being cancelled."""
    process = state.processes.get(name)
    return process is not None and process.wanted is DesiredState.CANCEL


def _stays_cancelled(state: MasterState, application: Application, name: str) -> bool:
    """Return True if a client has cancelled a process after the newest request to start it."""
    process, task = state.processes.get(name), application.tasks.get(name)
    if process is None or process.overdue or process.cancel_cause:
        return False
    return _is_cancelled(state, name) and (task is None or task.begun)


def want(state: MasterState, application: Application, number: int, now: float) -> None:
    """Make a version the desired one on request, and begin the work on it; 0: no version.

    Unfinished work continues if the same version is requested again; otherwise only on processes
    that the new version does not change. A process that was cancelled since starts again.
    """
    same = number == application.wanted
    # The version before may be one that was not reached yet.
    former = application.former if same else application.reached
    unfinished = {} if application.paused else application.tasks
    _set_wanted(state, application, number, now, former=former if number else 0, tasks=unfinished)


def _set_wanted(
    state: MasterState, application: Application, number: int, now: float, *, former: int,
    tasks: Mapping[str, Task] = EMPTY, stay_cancelled: AbstractSet[str] = frozenset(),
) -> None:  # fmt: skip
    """Begin the work on a version.

    Args:
        former: number of the version to which a failure leads back; 0: none.
        tasks: unfinished work; it continues where the version is the same or changes nothing.
        stay_cancelled: names of processes that are not started.
    """
    same = number == application.wanted
    application.returning = bool(application.former and not former and number)
    application.wanted, application.former, application.paused = number, former, ""
    application.behind.clear()
    names = state.names_of(application.name)
    found = differences(state, application.name, application.specs, names)
    found = {name: one for name, one in found.items() if name not in stay_cancelled}
    ending = [state.processes[name] for name, one in found.items() if one.action is Action.STOP]
    order = dict.fromkeys([one.name for one in dependants_first(state, ending)]) | found
    begun = {name: Task(replaces=found[name].action is Action.REPLACE) for name in order}
    # The specs of these processes do not differ, but their slaves have not made the change yet or
    # have refused it, or a replacement of them is under way or being undone.
    open_yet = {
        name: Task() for name in application.specs
        if (process := state.processes.get(name)) is not None
        and (name in state.unamended or state.replacement_of(process) is not None)
    }  # fmt: skip
    unchanged = application.specs.keys() - found.keys()
    live = {name for name in unchanged if not state.processes[name].phase.is_terminal}
    unfinished = {
        name: task for name, task in tasks.items()
        if (same or name in live) and not (name in found and _is_cancelled(state, name))
    }  # fmt: skip
    application.tasks = {**open_yet, **begun, **unfinished}
    state.save_application(application)
    _review(state, application, now)


def _note_end(state: MasterState, application: Application, now: float) -> None:
    """Record that the work on an application is done: it is as desired, degraded or cancelled."""
    version = application.version
    application.returning, application.former = False, 0
    if version is None:
        _note(state, application, now, EventKind.APPLICATION_CANCELLED, "is cancelled")
        return
    unwell = unwell_processes(state, application)
    if unwell:
        message = f"is degraded at version {version.number}: {described(unwell)}"
        _note(state, application, now, EventKind.APPLICATION_FAILED, message)
        return
    processes = counted(len(version.specs), "process", "processes")
    message = f"is at version {version.number} with {processes}"
    _note(state, application, now, EventKind.APPLICATION_APPLIED, message)


def _note(
    state: MasterState, application: Application, now: float, kind: EventKind, message: str
) -> None:
    facts = {"application": application.name, "version": application.wanted}
    state.record(now, kind, f"{application.name} {message}", facts=facts)
    state.save_application(application)
