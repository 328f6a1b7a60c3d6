"""Listings of applications as rows."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

from rosrm.core.master.applications.difference import difference_of
from rosrm.core.master.master_state import MasterState
from rosrm.core.master.state.applications import Application, Version
from rosrm.core.master.state.hosts import HostCondition
from rosrm.core.master.state.process import ProcessPhase
from rosrm.model.applications import Action, ApplicationRow, ApplicationState, VersionRow
from rosrm.wording import few, standing

#: Phases of a process that is as its application wants it; one that moves runs.
_WELL: Final = (ProcessPhase.RUNNING, ProcessPhase.MIGRATING, ProcessPhase.SCHEDULED)


def application_rows(state: MasterState) -> list[ApplicationRow]:
    """Return every application, in order of its first request."""
    return [_row(state, one) for one in state.applications.values()]


def _row(state: MasterState, application: Application) -> ApplicationRow:
    unwell = unwell_processes(state, application)
    tasks = {name: task.fault or task.reason for name, task in application.tasks.items()}
    pending = unknown_processes(state, application) | tasks
    condition = _condition(application, pending, unwell)
    return ApplicationRow(
        application.name, application.principal, condition, application.wanted,
        len(application.specs), len(application.specs) - len(unwell), pending,
        _reason(state, application, condition, unwell),
        tuple(_version_row(application, one) for one in application.versions.values()),
    )  # fmt: skip


def unwell_processes(state: MasterState, application: Application) -> dict[str, str]:
    """Return the processes that are not as the application desires, each with a predicate."""
    found = ((name, _why_unwell(state, application, name)) for name in application.specs)
    return {name: why for name, why in found if why}


def described(unwell: Mapping[str, str]) -> str:
    """Return a phrase on the first processes that are not as desired."""
    return "; ".join(few([f"{name} {why}" for name, why in unwell.items()]))


def _reason(
    state: MasterState, application: Application, condition: ApplicationState,
    unwell: Mapping[str, str],
) -> str:  # fmt: skip
    """Return why an application is not as desired, or which mode has it although cancelled."""
    mode = state.modes.mode
    if condition == "degraded":
        return described(unwell)
    if condition == "cancelled" and mode is not None and application.name in mode.applications:
        return f"the mode {mode.name} has it: `rosrm mode {mode.name}` applies it again"
    return application.paused


def unknown_processes(state: MasterState, application: Application) -> dict[str, str]:
    """Return the desired processes whose state is not known since the master started, and why.

    Their hosts have reported neither yet, nor are they lost: most of them run.
    """
    found: dict[str, str] = {}
    if not (state.hosts.condition == HostCondition.EXPECTED).any():
        return found
    for name in application.specs:
        process = state.processes.get(name)
        for number in process.instances if process is not None else ():
            host = state.instances[number].host
            if state.hosts.condition_of(host) is HostCondition.EXPECTED:
                found[name] = f"{host.name} {state.hosts.why_unreachable(host)}"
    return found


def _condition(
    application: Application, pending: dict[str, str], unwell: dict[str, str]
) -> ApplicationState:
    if application.paused:
        return "paused"
    if pending:
        return "returning" if application.returning else "applying"
    if not application.wanted:
        return "cancelled"
    return "degraded" if unwell else "running"


def _why_unwell(state: MasterState, application: Application, name: str) -> str:
    """Return a predicate for a process of an application that is not as desired; "" if it is."""
    process = state.processes.get(name)
    if process is None or process.spec.application != application.name:
        return "does not exist any more"
    if name not in application.tasks and _is_of_another_version(state, application, name):
        return "is still of another version"
    pending = state.unamended.get(name)
    if pending is not None and pending.refusal and name not in application.tasks:
        return f"is not changed: {pending.refusal}"
    if process.phase in _WELL or process.is_finished_job:
        return ""
    if process.phase is ProcessPhase.FINISHED:
        return "has finished, but is a service: `rosrm apply` starts it again"
    reason = f": {process.reason}" if process.reason else ""
    return f"{standing(process.phase.value)}{reason}"


def _is_of_another_version(state: MasterState, application: Application, name: str) -> bool:
    """Return True if a process that runs was to be replaced, which has failed for good."""
    difference = difference_of(state, application.name, name, application.specs[name])
    return difference is not None and difference.action is Action.REPLACE


def _version_row(application: Application, version: Version) -> VersionRow:
    return VersionRow(
        version.number, version.wall, version.by, len(version.specs), version.note,
        version.given_up, version.number == application.wanted,
    )  # fmt: skip
