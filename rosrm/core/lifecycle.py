"""What becomes of instances, and what that means for their processes."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Final

import numpy as np

from rosrm.core import events as happened
from rosrm.core.commands import Order
from rosrm.core.hosts import Host
from rosrm.core.model import InstanceState, InstanceStatus
from rosrm.core.state import Instance, MasterState, Process, ProcessPhase, Wanted
from rosrm.ports import Intent

#: What the state of the owning instance means for the process.
_PHASE: Final = {
    InstanceState.STARTING: ProcessPhase.STARTING,
    InstanceState.RUNNING: ProcessPhase.STARTING,
    InstanceState.READY: ProcessPhase.RUNNING,
    InstanceState.BACKOFF: ProcessPhase.BACKOFF,
    InstanceState.STOPPING: ProcessPhase.STOPPING,
}


def statuses_received(state: MasterState, event: happened.StatusesReceived, now: float) -> None:
    """Take in what a slave says of its instances, in order."""
    host = state.hosts.find(event.host_id, event.incarnation)
    if host is None:
        return
    without_gap = state.hosts.note_statuses(host, event.sequence, now)
    if event.complete:
        state.missing_since.pop(host.column, None)
        reconcile(state, host, event.statuses, now)
        return
    if not without_gap:
        state.emit(Order(state.order_id(), host.host_id, "report"))
    for status in event.statuses:
        take_status(state, host, status, now)


def reconcile(
    state: MasterState, host: Host, statuses: Iterable[InstanceStatus], now: float,
    *, registering: bool = False,
) -> None:  # fmt: skip
    """Compare all that a host holds with what is intended there.

    An assignment of which the host has said nothing may be on its way, unless the host is
    `registering`: a slave takes up nothing that was sent before its registration.
    """
    held = {status.instance.number: status for status in statuses}
    for status in held.values():
        take_status(state, host, status, now)
    for number in list(host.instances - held.keys()):
        instance = state.instances[number]
        if instance.state is None and not registering:
            continue
        _gone(state, instance, now, f"{host.name} does not hold it any more")


def take_status(state: MasterState, host: Host, status: InstanceStatus, now: float) -> None:
    """One instance changed."""
    instance = state.instances.get(status.instance.number)
    if instance is None or instance.host is not host:
        _stop_stranger(state, host, status)
        return
    changed = instance.state is not status.state
    instance.state, instance.pid, instance.restarts = status.state, status.pid, status.restarts
    if status.state.ended:
        _ended(state, instance, status, now)
        return
    process = state.processes[instance.id.process]
    if process.owner != instance.id.number:
        return
    process.restarts = status.restarts
    if process.wanted is not Wanted.RUN and not instance.stopping:
        stop_instance(state, instance, now)
    if process.name not in state.runs and changed:
        _follow(state, process, instance, status, now)


def _follow(
    state: MasterState, process: Process, instance: Instance, status: InstanceStatus, now: float
) -> None:
    """The process goes where its owning instance went."""
    phase = _PHASE[status.state]
    if process.wanted is Wanted.CANCEL:
        phase = ProcessPhase.STOPPING
    before = process.phase
    state.set_phase(process, phase, now, status.message)
    if phase is not before:
        kind = {"running": "ready"}.get(phase.value, phase.value)
        state.record(
            now, kind, f"{process.name} is {kind} on {instance.host.name}"
            + (f": {status.message}" if status.message else ""),
            process=process.name, host=instance.host.name,
            facts={"number": instance.id.number, "pid": status.pid, "restarts": status.restarts},
        )  # fmt: skip
        if phase in (ProcessPhase.RUNNING, ProcessPhase.BACKOFF):
            state.save(process)


def _stop_stranger(state: MasterState, host: Host, status: InstanceStatus) -> None:
    """An instance that nobody intends here must not run: it may have a successor elsewhere."""
    if not status.state.ended and status.state is not InstanceState.STOPPING:
        state.emit(Order(state.order_id(), host.host_id, "stop", status.instance))


def stop_instance(state: MasterState, instance: Instance, now: float) -> None:
    """Order an instance to stop, for good; asked again until it has ended."""
    instance.stopping = True
    instance.order, instance.order_at = state.order_id(), now
    state.emit(Order(instance.order, instance.host.host_id, "stop", instance.id))


# --- ends -------------------------------------------------------------------------------------


def _ended(state: MasterState, instance: Instance, status: InstanceStatus, now: float) -> None:
    process = state.processes[instance.id.process]
    _learn(state, process, instance, status)
    state.drop_instance(instance)
    run = state.runs.get(process.name)
    if run is not None:
        run.ended[instance.id.number] = status
    if process.owner != instance.id.number:
        state.record(
            now, "instance_ended", f"{instance.id} ended on {instance.host.name}"
            + (f": {status.message}" if status.message else ""),
            process=process.name, host=instance.host.name,
        )  # fmt: skip
        return
    process.exit_code = status.exit_code or -status.exit_signal
    if run is None:  # else the plan in hand knows what this end means
        conclude(state, process, status, instance.host, now)


def conclude(
    state: MasterState, process: Process, status: InstanceStatus, host: Host, now: float
) -> None:
    """The owning instance has ended, and no plan is under way: what becomes of the process?"""
    process.owner = 0
    if process.wanted is Wanted.CANCEL:
        _finish(state, process, ProcessPhase.CANCELLED, "cancelled", host, now, "")
    elif process.wanted is Wanted.REQUEUE:
        _requeue(state, process, host, now, f"it was ended on {host.name}")
    elif status.state is InstanceState.REFUSED:
        process.excluded[host.name] = status.message or "its slave refused it"
        _requeue(state, process, host, now, f"{host.name} cannot run it: {status.message}")
    elif status.state is InstanceState.EXITED and process.exit_code == 0:
        _finish(state, process, ProcessPhase.FINISHED, "finished", host, now, status.message)
    else:
        reason = status.message or f"exit code {process.exit_code}"
        _finish(state, process, ProcessPhase.FAILED, "failed", host, now, reason)


def _finish(
    state: MasterState, process: Process, phase: ProcessPhase, kind: str, host: Host, now: float,
    reason: str,
) -> None:  # fmt: skip
    state.set_phase(process, phase, now, reason)
    state.record(
        now, kind, f"{process.name} {kind} on {host.name}" + (f": {reason}" if reason else ""),
        process=process.name, host=host.name, facts={"exit_code": process.exit_code},
    )  # fmt: skip
    state.save(process)


def _requeue(state: MasterState, process: Process, host: Host, now: float, reason: str) -> None:
    state.enqueue(process, now, "")
    state.record(
        now, "queued", f"{process.name} returns to the queue: {reason}", process=process.name,
        host=host.name,
    )  # fmt: skip
    state.save(process)


def _gone(state: MasterState, instance: Instance, now: float, reason: str) -> None:
    """The host is heard, and says nothing of an instance that should be there."""
    process = state.processes[instance.id.process]
    state.drop_instance(instance)
    run = state.runs.get(process.name)
    if run is not None:
        run.ended[instance.id.number] = InstanceStatus(
            instance.id, InstanceState.FAILED, exit_code=1, message=reason
        )
        return
    if process.owner != instance.id.number:
        return
    process.owner = 0
    if process.wanted is Wanted.CANCEL:
        _finish(state, process, ProcessPhase.CANCELLED, "cancelled", instance.host, now, reason)
    else:
        _requeue(state, process, instance.host, now, reason)


def assignment_withdrawn(
    state: MasterState, event: happened.AssignmentWithdrawn, now: float
) -> None:
    """The slave never saw it: the process goes back to its place."""
    instance = state.instances.get(event.instance.number)
    if instance is not None:
        _gone(state, instance, now, f"{instance.host.name} did not take it up in time")


def lost_sight(state: MasterState, host: Host, now: float) -> None:
    """A host is lost: its processes are out of reach, not gone."""
    for number in host.instances:
        process = state.processes[state.instances[number].id.process]
        if process.owner == number and process.name not in state.runs:
            state.set_phase(process, ProcessPhase.UNREACHABLE, now, f"{host.name} is lost")


def regained_sight(state: MasterState, host: Host, now: float) -> None:
    """A lost host is heard again: its processes are again what their instances were last."""
    for number in host.instances:
        instance = state.instances[number]
        process = state.processes[instance.id.process]
        if process.owner == number and process.phase is ProcessPhase.UNREACHABLE:
            phase = _PHASE.get(instance.state) if instance.state else ProcessPhase.ASSIGNED
            state.set_phase(process, phase or ProcessPhase.STARTING, now)


# --- what counts against a host ---------------------------------------------------------------


def settle_charge(state: MasterState, instance: Instance, now: float) -> None:
    """Lower what is counted in flight to what does not show in the readings yet."""
    table = state.hosts
    settled = now - instance.since >= state.settings.settle
    left = {}
    for resource, amount in instance.amounts.items():
        hidden = amount - instance.seen.get(resource, 0.0)
        left[resource] = 0.0 if settled and resource in instance.estimated else max(0.0, hidden)
    need = table.fractions_of(instance.host, left)
    need = np.where(np.isfinite(need), need, 0.0)
    change = need.copy()
    change[: len(instance.charged)] -= instance.charged
    if np.any(change):
        instance.charged = need
        table.charge(instance.host, change)


def _learn(
    state: MasterState, process: Process, instance: Instance, status: InstanceStatus
) -> None:
    """Remember what a run used, for the next process of the same program."""
    if status.state is InstanceState.REFUSED:
        return
    cpu = status.cpu_time / status.run_time if status.run_time > 0.0 else 0.0
    peaks = {
        "memory": max(status.peak_memory, instance.peak.get("memory", 0.0)),
        "cpu": max(cpu, instance.peak.get("cpu", 0.0)),
    }
    if any(peaks.values()):
        program = process.spec.program
        state.emit(Intent("learned", program, dict(state.learned.learn(program, peaks))))
