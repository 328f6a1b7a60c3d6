"""Adoption of a process that runs on a host already.

The host is given, and the process needs no room there, because the readings include it. So it is
assigned in the turn of its submission, without a placement. Its spec names the running process
until the slave reports that it runs. From then on it is a process like any other: a restart or a
move starts its program. If it is not adopted, the process fails, because a start would be a second
copy of a program that may still run.
"""

from __future__ import annotations

from dataclasses import replace

from rosrm.core.master.master_state import MasterState
from rosrm.core.master.outcomes import RequestRefused
from rosrm.core.master.recovery.journal_gap import why_no_work
from rosrm.core.master.state.hosts import HostCondition
from rosrm.core.master.state.process import Instance, Process
from rosrm.model.adoption import NO_ADOPTION, Adoption
from rosrm.wording import no_such


def check_adoption(state: MasterState, adoption: Adoption, now: float) -> None:
    """Refuse an adoption on a host that is unknown or away, or of a process that rosrm runs."""
    host = state.hosts.by_name.get(adoption.host)
    if host is None:
        raise RequestRefused(no_such("host", [adoption.host], list(state.hosts.by_name)), "unknown")
    condition = state.hosts.condition_of(host)
    why = why_no_work(state, now)
    if condition is not HostCondition.UP:
        why = f"{host.name} {condition.words()}"
    for instance in state.instances_of(host):
        if instance.pid == adoption.pid:
            why = f"it is the process {instance.id.process} already"
    if why:
        raise RequestRefused(f"process {adoption.pid} of {host.name} is not adopted: {why}")


def is_pending(process: Process) -> bool:
    """Return True if the slave has not reported the success or failure of an adoption yet."""
    return process.spec.adoption != NO_ADOPTION


def note_running(state: MasterState, process: Process, owner: Instance) -> None:
    """Note that a process is adopted, if its owner runs."""
    if owner.is_running and is_pending(process):
        end_adoption(state, process)


def end_adoption(state: MasterState, process: Process) -> None:
    """Note that the adoption of a process has succeeded or failed: later runs are started."""
    state.amend_spec(process, replace(process.spec, adoption=NO_ADOPTION))
