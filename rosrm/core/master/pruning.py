"""Removal of what has ended or left, from memory, journal and listings."""

from __future__ import annotations

from typing import Final

from rosrm.core.master import events as happened
from rosrm.core.master import lifecycle
from rosrm.core.master.commands import Reply
from rosrm.core.master.dependants import binding_dependants
from rosrm.core.master.garbage import (
    is_gone,
    is_wanted_job,
    remove_application,
    remove_process,
)
from rosrm.core.master.hosts.liveness import lease_of
from rosrm.core.master.master_state import MasterState
from rosrm.core.master.outcomes import RequestRefused
from rosrm.core.master.requests import count, known_host, known_processes
from rosrm.core.master.state.applications import Application
from rosrm.core.master.state.hosts import Host, HostCondition
from rosrm.core.master.state.process import DesiredState, Process, ProcessPhase
from rosrm.model.event_kinds import EventKind
from rosrm.model.records import Intent
from rosrm.model.requester import Requester
from rosrm.wording import counted, each_of, listed

_DEPARTED: Final = (HostCondition.LEFT, HostCondition.DETACHED)


def prune_requested(state: MasterState, event: happened.PruneRequested, now: float) -> None:
    """Remove all named processes and hosts, or refuse; without names, all that ended or left.

    Without names, cancelled applications are removed, too, with their versions.
    """
    if event.names or event.hosts:
        processes, hosts = _named(state, event, now)
    else:
        ended = [state.processes[name] for name in state.terminal]
        own = [process for process in ended if event.by.may_act_on(process.principal)]
        processes = [process for process in own if not _why_not_pruned(state, process)]
        left = [
            host
            for host in state.hosts.listed()
            if state.hosts.condition_of(host) in _DEPARTED and not host.instances
        ]
        hosts = [host for host in left if not _why_not_pruned_host(state, host, now)]
    for process in processes:
        remove_process(state, process.name)
    applications = [] if event.names or event.hosts else _cancelled_applications(state, event.by)
    for application in applications:
        remove_application(state, application)
    left_running = [_prune_host(state, host, event.by, now) for host in hosts]
    removed = [count(len(processes))] if processes else []
    removed += [counted(len(applications), "application")] if applications else []
    if removed:
        state.record(now, EventKind.PRUNED, f"{listed(removed)} removed", by=event.by)
    removed += [counted(len(hosts), "host")] if hosts else []
    message = f"{listed(removed)} removed" if removed else "nothing to remove"
    state.emit(Reply(event.request, message="; ".join([message, *filter(None, left_running)])))


def _cancelled_applications(state: MasterState, by: Requester) -> list[Application]:
    """Return the cancelled applications without a process."""
    used = {process.spec.application for process in state.processes.values()}
    return [
        one for one in state.applications.values()
        if not one.wanted and not one.tasks and one.name not in used
        and by.may_act_on(one.principal)
    ]  # fmt: skip


def _named(
    state: MasterState, event: happened.PruneRequested, now: float
) -> tuple[list[Process], list[Host]]:
    """Return the processes and hosts that a request names; refuse it if one cannot be removed."""
    processes = known_processes(state, event.names, event.by)
    hosts = [known_host(state, name) for name in dict.fromkeys(event.hosts)]
    faults = [_why_not_pruned(state, process) for process in processes]
    faults += [_why_not_pruned_host(state, host, now) for host in hosts]
    for fault in filter(None, faults):
        raise RequestRefused(f"{fault}. Nothing was removed")
    return processes, hosts


def _why_not_pruned(state: MasterState, process: Process) -> str:
    """Return why a process cannot be removed; "" if it can."""
    if not process.phase.is_terminal:
        return f"{process.name} is {process.phase.value}; cancel it first"
    if process.instances:
        instance = state.instances[min(process.instances)]
        return f"{instance.id} is still being stopped on {instance.host.name}"
    if names := binding_dependants(state, process):
        after = f"{each_of(names)} starts after {process.name}, and has not ended"
        return f"{after}; cancel {listed(names)} first"
    if is_wanted_job(state, process):
        name = process.spec.application
        return (
            f"{process.name} is a finished job of the application {name}, and would run again at "
            f"the next `rosrm apply`; cancel {name}, or remove the job from its file first"
        )
    return "" if is_gone(state, process) else f"the standby of {process.name} is being ended"


def _why_not_pruned_host(state: MasterState, host: Host, now: float) -> str:
    """Return why a host cannot be removed; "" if it can."""
    condition = state.hosts.condition_of(host)
    if condition is HostCondition.UP:
        return f"{host.name} is up; stop its slave first"
    if condition is HostCondition.SUSPECT:
        silence = now - float(state.hosts.last_contact[host.column])
        return (
            f"{host.name} is suspect: it has not reported for {silence:.1f} s and may report "
            f"again. Stop its slave if it runs; a host can be pruned once it has left or is lost, "
            f"which is after {lease_of(state, host):g} s of silence"
        )
    held = state.instances_of(host)
    owned = [one.id.process for one in held if (process := state.owned_by(one)) is not None
             and process.wanted is not DesiredState.CANCEL]  # fmt: skip
    if owned and condition is HostCondition.LEFT:
        end = "it has ended" if len(owned) == 1 else "they have ended"
        return f"{host.name} is still stopping {listed(owned)}; wait until {end}"
    if owned:
        them = "it" if len(owned) == 1 else "them"
        return f"{host.name} may still run {listed(owned)}; cancel {them} first"
    for instance in held:
        if instance.id.process in state.migrations:
            return f"{instance.id.process} is moving from or to {host.name}"
    for name in state.images_on(host):
        return f"the image of {name} is on {host.name}; cancel {name} first"
    return ""


def _prune_host(state: MasterState, host: Host, by: Requester, now: float) -> str:
    """Remove a host, and give up its instances; they are stopped if the host returns.

    Returns:
        A sentence: the processes that may still run there, and the command that stops them; ""
        if none may.
    """
    ends_all = state.hosts.condition_of(host) is HostCondition.LEFT
    state.hosts.prune(host)
    state.link_queries.remove(host.name)
    held = state.instances_of(host)
    for instance in held:
        lifecycle.gone(state, instance, now, f"{host.name} was pruned")
    names = [] if ends_all else list(dict.fromkeys(instance.id.process for instance in held))
    for process in [state.processes[name] for name in names if name in state.processes]:
        if process.phase is ProcessPhase.CANCELLED:
            process.reason = f"it may still run on {host.name}, which was removed"
            state.save(process)
    state.emit(Intent("host", host.name, None))
    state.record(now, EventKind.HOST_PRUNED, f"{host.name} was removed", host=host.name, by=by)
    if not names:
        return ""
    them = "it" if len(names) == 1 else "them"
    return (
        f"{listed(names)} may still run on {host.name}: `rosrm slave --stop-all` on that host "
        f"stops {them}"
    )
