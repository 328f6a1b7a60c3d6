"""Registration of hosts, requests for work, readings, departure."""

from __future__ import annotations

from collections.abc import Iterable
from math import inf
from typing import Final

import numpy as np

from rosrm.core.master import events as happened
from rosrm.core.master import lifecycle
from rosrm.core.master.assignment.assign import reconsider_set_aside
from rosrm.core.master.assignment.reservations import settle_reservation
from rosrm.core.master.checkpoint import replication
from rosrm.core.master.commands import RefusalCode, Reply
from rosrm.core.master.hosts import loss
from rosrm.core.master.hosts.liveness import lease_end, mark_up
from rosrm.core.master.hosts.readings import take_readings
from rosrm.core.master.master_state import MasterState
from rosrm.core.master.outcomes import RequestRefused
from rosrm.core.master.recovery.journal_gap import note_seen
from rosrm.core.master.state.host_arrays import FloatArray
from rosrm.core.master.state.hosts import Host, HostCondition
from rosrm.core.master.state.process import DesiredState, ProcessPhase
from rosrm.model.description_checks import description_fault
from rosrm.model.event_kinds import EventKind
from rosrm.model.orders import ReportInstances
from rosrm.model.plan import Execute
from rosrm.model.records import Intent
from rosrm.model.values import InstanceStatus
from rosrm.wording import counted

#: Seconds between two records of the same fault of the same host.
_RECORD_PERIOD: Final = 10.0


def host_registered(state: MasterState, event: happened.HostRegistered, now: float) -> None:
    """Register a host, unless a live slave has its name."""
    description = event.description
    fault = description_fault(description)
    if fault:
        raise _refusal(state, event, fault, "invalid", now)
    known = state.hosts.by_name.get(description.name)
    if known is not None and known.description.incarnation == description.incarnation:
        _registered_again(state, known, event, now)
        return
    taken = _name_taken(state, known, event)
    if taken:
        raise _refusal(state, event, taken, "name_taken", now)
    is_new = known is None or known.pruned
    host = state.hosts.register(description, now)
    host.failing.clear()  # the slave reports the plugins that fail in this run
    if is_new:
        save_host(state, host)
    state.record(
        now, EventKind.HOST_REGISTERED, f"{host.name} registered with {_live(event.instances)}",
        host=host.name,
        facts={
            "host_id": host.host_id, "labels": dict(description.labels),
            "resources": {r.name: r.capacity for r in description.resources},
            "absent": dict(description.absent),
        },
    )  # fmt: skip
    note_seen(state, host.name, event.journal_seen, now)
    replication.note_states(state, host, event.kept, now)  # replicas decide on placement
    loss.mark_rejoined(state, host, now)
    stopping = [instance for instance in state.instances_of(host) if instance.stopping]
    lifecycle.reconcile(state, host, event.instances, now, registering=True)
    for instance in stopping:  # the former run of the slave may not have carried out the order
        if instance.id.number in state.instances:
            lifecycle.stop_instance(state, instance, now)
    _clear_exclusions(state, host)
    _execute_again(state, host)
    reconsider_set_aside(state, now)
    state.emit(Reply(event.request, host_id=host.host_id))


def _live(held: Iterable[InstanceStatus]) -> str:
    """Count the instances in a slave's report that have not ended: "2 processes"."""
    return counted(sum(not one.state.ended for one in held), "process", "processes")


def _execute_again(state: MasterState, host: Host) -> None:
    """Repeat the steps whose executor ended with the slave's former run."""
    for migration in state.migrations.values():
        step = migration.current_step
        if isinstance(step, Execute) and step.host == host.name:
            migration.begun = False


def _refusal(
    state: MasterState, event: happened.HostRegistered, why: str, code: RefusalCode, now: float
) -> RequestRefused:
    """Return the refusal of a registration, and record it."""
    known = state.hosts.by_name.get(event.description.name)
    if known is None:
        state.record(now, EventKind.HOST_REFUSED, why, host=event.description.name)
    else:  # a slave whose name is taken retries for a moment
        _record_seldom(state, known, EventKind.HOST_REFUSED, now, why)
    return RequestRefused(why, code)


def _registered_again(
    state: MasterState, host: Host, event: happened.HostRegistered, now: float
) -> None:
    """Answer a repeated registration: the first answer was lost, or the request arrived twice.

    All later reports of the slave count. The instances in this request may be outdated, so the
    master orders a full report in sequence.
    """
    state.hosts.last_contact[host.column] = now
    replication.note_states(state, host, event.kept, now)
    condition = state.hosts.condition_of(host)
    if condition in (HostCondition.LOST, HostCondition.SUSPECT):
        mark_up(state, host, now)
    if condition is not HostCondition.LOST:
        state.send(host, ReportInstances())
    state.emit(Reply(event.request, host_id=host.host_id))


def _clear_exclusions(state: MasterState, host: Host) -> None:
    """Clear the exclusions and reasons that stem from the former run of a host's slave.

    The slave may now have the files and plugins that it lacked. Instances of cancelled processes
    that were still running there are stopped by the registration.
    """
    for name in state.terminal:
        process = state.processes[name]
        if process.phase is ProcessPhase.CANCELLED and process.ended_on == host.name:
            process.reason = ""
    for process in state.processes.values():
        if host.name in process.excluded and not process.phase.is_terminal:
            del process.excluded[host.name]
            process.demand = None


def _name_taken(state: MasterState, known: Host | None, event: happened.HostRegistered) -> str:
    if known is None or state.hosts.condition_of(known) is not HostCondition.UP:
        return ""
    first = known.description
    return (
        f"a live slave has the name {first.name!r} already: pid {first.pid} on {first.hostname}; "
        f"give this one (pid {event.description.pid} on {event.description.hostname}) another "
        f"`host:` in its configuration, or stop the first"
    )


def save_host(state: MasterState, host: Host) -> None:
    """Persist the desired state of a host."""
    desired = {"host_id": host.host_id, "cordoned": host.cordoned, "draining": host.draining}
    state.emit(Intent("host", host.name, desired))


def host_left(state: MasterState, event: happened.HostLeft, now: float) -> None:
    """Handle the stop of a slave.

    Processes that the slave ends return to the queue; a slave that leaves them running is detached.
    """
    host = state.hosts.find(event.host_id, event.incarnation)
    if host is None:
        raise RequestRefused("this host is not registered", "unknown")
    if event.kept:
        _detach(state, host, event.kept, now)
        state.emit(Reply(event.request))
        return
    state.hosts.set_condition(host, HostCondition.LEFT)
    state.record(now, EventKind.HOST_LEFT, f"{host.name} leaves: its slave stops", host=host.name)
    for instance in state.instances_of(host):
        process = state.owned_by(instance)
        if process is not None and process.wanted is DesiredState.RUN:
            process.wanted = DesiredState.REQUEUE
            state.save(process)
    state.emit(Reply(event.request))


def _detach(state: MasterState, host: Host, kept: tuple[InstanceStatus, ...], now: float) -> None:
    """Detach a host: adopt the reported instances; an instance not reported has not begun."""
    state.hosts.set_condition(host, HostCondition.DETACHED)
    state.record(
        now, EventKind.HOST_DETACHED,
        f"{host.name} is detached: its slave was stopped and left {_live(kept)} running",
        host=host.name,
    )  # fmt: skip
    lifecycle.reconcile(state, host, kept, now, registering=True)
    loss.detach(state, host, lease_end(state, host), now)


def process_requested(state: MasterState, event: happened.ProcessRequested, now: float) -> None:
    """Note the open request of a host; the answer follows when there is work."""
    host = state.hosts.find(event.host_id, event.incarnation)
    if host is None:
        raise RequestRefused("register first", "unknown")
    state.hosts.ask(host)


def readings_received(state: MasterState, event: happened.ReadingsReceived, now: float) -> None:
    """Store a batch of readings; refuse and record invalid ones."""
    first = bool(state.set_aside) and bool(state.hosts.without_reading().any())
    refused = take_readings(state.hosts, event, now)
    if first:  # before placement, so that requeued processes keep their order
        reconsider_set_aside(state, now)
    for row in np.flatnonzero(refused):
        host = state.hosts.find(int(event.host_id[row]), int(event.incarnation[row]))
        if host is not None:
            fault = (
                f"a reading of {host.name} was refused (NaN, negative, absurd, or a limit outside "
                f"0..1): usage {_shown(event.usage[row])}, limit {_shown(event.limit[row])}"
            )
            _record_seldom(state, host, EventKind.READING_REFUSED, now, fault)


def _shown(values: FloatArray) -> str:
    return "[" + ", ".join(f"{value:.3g}" for value in values[:8]) + ", …]"


def _record_seldom(
    state: MasterState, host: Host, kind: EventKind, now: float, message: str
) -> None:
    if now - host.recorded_at.get(kind, -inf) >= _RECORD_PERIOD:
        host.recorded_at[kind] = now
        state.record(now, kind, message, host=host.name)


def usages_received(state: MasterState, event: happened.UsagesReceived, now: float) -> None:
    """Lower reservations by the usage that readings now show."""
    host = state.hosts.find(event.host_id, event.incarnation)
    if host is None:
        return
    for number, cpu, memory in zip(event.numbers, event.cpu, event.memory, strict=True):
        instance = state.instances.get(int(number))
        if instance is None or instance.host is not host:
            continue
        if not (np.isfinite(cpu) and np.isfinite(memory) and cpu >= 0.0 and memory >= 0.0):
            fault = f"a usage of {instance.id} was refused (NaN or negative)"
            _record_seldom(state, host, EventKind.READING_REFUSED, now, fault)
            continue
        instance.seen = {"cpu": float(cpu), "memory": float(memory)}
        for resource, amount in instance.seen.items():
            instance.peak[resource] = max(amount, instance.peak.get(resource, 0.0))
        settle_reservation(state, instance, now)


def peer_refused(state: MasterState, event: happened.PeerRefused, now: float) -> None:
    """Record a message that was refused at the network edge."""
    state.record(now, EventKind.PEER_REFUSED, f"{event.who} was refused: {event.reason}")
