"""Difference between the processes of an application and the desired ones."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from rosrm.core.master.master_state import MasterState
from rosrm.core.master.state.process import DesiredState, Process
from rosrm.core.master.state.spec_changes import IN_PLACE, changed_fields, with_in_place
from rosrm.model.applications import Action
from rosrm.model.values import ProcessSpec


@dataclass(frozen=True, slots=True)
class Difference:
    """Difference between one process and the desired one.

    Attributes:
        action: action by which the process gets as desired.
        fields: names of the changed fields of the spec.
        reason: cause of the action, if it is not a changed field.
    """

    action: Action
    fields: tuple[str, ...] = ()
    reason: str = ""


def differences(
    state: MasterState, application: str, specs: Mapping[str, ProcessSpec], names: Iterable[str]
) -> dict[str, Difference]:
    """Return the difference of each process that is not as desired.

    Args:
        specs: the desired processes.
        names: names of the processes that the application may have now.
    """
    found = {}
    for name in dict.fromkeys((*names, *specs)):
        difference = difference_of(state, application, name, specs.get(name))
        if difference is not None:
            found[name] = difference
    return found


def difference_of(
    state: MasterState, application: str, name: str, spec: ProcessSpec | None
) -> Difference | None:
    """Return the difference of one process; None: it is as desired.

    Args:
        spec: the desired process; None: none is desired.
    """
    process = state.processes.get(name)
    if process is not None and process.spec.application != application:
        process = None  # an ended process of another one
    if spec is None:
        lives = process is not None and not process.phase.is_terminal
        return Difference(Action.STOP) if lives else None
    if process is None:
        return Difference(Action.START)
    if process.phase.is_terminal or process.wanted is DesiredState.CANCEL:
        return _of_ended(process, spec)
    changed = changed_fields(state.spec_to_be(process), spec)
    if not changed:
        return None
    in_place = _needs_no_start(state, process, changed, spec)
    return Difference(Action.CHANGE if in_place else Action.REPLACE, changed)


def _of_ended(process: Process, spec: ProcessSpec) -> Difference | None:
    """Return why an ended process is started again; None: it is a job that has finished.

    A change that needs no new start does not repeat a job.
    """
    changed = changed_fields(process.spec, spec)
    if process.is_finished_job and IN_PLACE.union({"limits"}).issuperset(changed):
        return None
    return Difference(Action.START, changed, f"it is {process.phase.value} now")


def with_changes_in_place(
    state: MasterState, process: Process, desired: ProcessSpec
) -> ProcessSpec:
    """Return the spec of a process with those fields of the desired one that need no new start."""
    spec = process.spec
    if spec.limits != desired.limits:
        changed = changed_fields(spec, desired)
        if _needs_no_start(state, process, changed, desired):
            return desired
    return with_in_place(spec, desired)


def _needs_no_start(
    state: MasterState, process: Process, changed: Iterable[str], desired: ProcessSpec
) -> bool:
    """Return True if a process can be as desired without a new start."""
    others = set(changed) - IN_PLACE
    if others != {"limits"}:
        return not others
    owner = state.owner_of(process)
    return owner is not None and (
        desired.limits.enforce != "required"
        or owner.host.enforces(desired.enforcement, desired.cpus)
    )
