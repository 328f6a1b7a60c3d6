"""Removal of terminal processes and cancelled applications from memory and journal."""

from __future__ import annotations

from rosrm.core.master.dependants import binding_dependants
from rosrm.core.master.master_state import MasterState, process_key, version_key
from rosrm.core.master.state.applications import Application
from rosrm.core.master.state.intents import version_intent
from rosrm.core.master.state.process import Process, ProcessPhase
from rosrm.model.records import Intent


def collect_garbage(state: MasterState) -> None:
    """Keep the newest `keep_ended` of the terminal processes that may be removed."""
    if len(state.terminal) <= state.settings.keep_ended:
        return
    gone = [name for name in state.terminal if is_gone(state, state.processes[name])]
    for name in gone[: max(0, len(gone) - state.settings.keep_ended)]:
        remove_process(state, name)


def is_gone(state: MasterState, process: Process) -> bool:
    """Return True if a terminal process may be removed.

    Neither an instance nor a standby of it may run, no live process starts after it, and it is no
    finished job that its application still wants: without it, the job would run again.
    """
    is_used = binding_dependants(state, process) or is_wanted_job(state, process)
    return not state.may_run(process) and not is_used


def is_wanted_job(state: MasterState, process: Process) -> bool:
    """Return True for a finished job of the desired version of an application."""
    application = state.applications.get(process.spec.application)
    finished = process.phase is ProcessPhase.FINISHED
    return finished and application is not None and process.name in application.specs


def remove_application(state: MasterState, application: Application) -> None:
    """Remove a cancelled application with its versions."""
    del state.applications[application.name]
    state.unsaved.applications.pop(application.name, None)
    for number in application.versions:
        state.ledger.remove(application.principal, version_key(application.name, number))
        state.emit(version_intent(application.name, number, None))
    state.emit(Intent("application", application.name, None))


def remove_process(state: MasterState, name: str) -> None:
    """Remove a terminal process; none of its instances may run."""
    del state.terminal[name]
    state.replication.last_orders.pop(name, None)
    process = state.processes.pop(name)
    state.ledger.remove(process.principal, process_key(name))
    if state.declared.may_have_snapshots(process.spec):
        _note_removed(state, name)
    state.unsaved.processes.pop(name, None)
    state.emit(Intent("process", name, None))


def _note_removed(state: MasterState, name: str) -> None:
    """Journal the removal of a stateful process, because a host may return with a replica."""
    oldest = state.replication.removed.put(name, state.next_instance)
    state.emit(Intent("removed", name, {"next": state.next_instance}))
    if oldest is not None:
        state.emit(Intent("removed", oldest, None))
