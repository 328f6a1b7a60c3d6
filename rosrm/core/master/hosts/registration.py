"""Registration of hosts, requests for work, readings, departure."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Final

import numpy as np

from rosrm.core.master import events as happened
from rosrm.core.master import lifecycle
from rosrm.core.master.assignment.assign import reconsider_set_aside
from rosrm.core.master.assignment.reservations import settle_reservation
from rosrm.core.master.checkpoint import replication
from rosrm.core.master.commands import RefusalCode, Reply
from rosrm.core.master.hosts import loss
from rosrm.core.master.hosts.devices import note_devices
from rosrm.core.master.hosts.liveness import lease_end, mark_up
from rosrm.core.master.hosts.readings import take_readings
from rosrm.core.master.master_state import RECORD_PERIOD, MasterState
from rosrm.core.master.outcomes import RequestRefused
from rosrm.core.master.recovery.journal_gap import note_seen
from rosrm.core.master.state.backoff import Backoff
from rosrm.core.master.state.host_arrays import FloatArray
from rosrm.core.master.state.hosts import Host, HostCondition
from rosrm.core.master.state.process import DesiredState, Instance, Process, ProcessPhase
from rosrm.model.codec import to_plain
from rosrm.model.description_checks import description_fault
from rosrm.model.event_kinds import EventKind
from rosrm.model.plan import Execute
from rosrm.model.records import Intent
from rosrm.model.values import HostDescription, InstanceStatus, is_plausible
from rosrm.wording import counted, listed

#: Seconds after its `leave` for which readings that a slave sent before may arrive.
_STILL_THERE: Final = 3.0
#: Fields that a slave may describe in another way, in messages.
_CHANGES: Final = {
    "labels": "labels", "resources": "resources", "absent": "absent probes",
    "launchers": "launchers",
}  # fmt: skip
#: Most different resources of all hosts: each is a row of the table, which never gets smaller.
_MOST_RESOURCES: Final = 64


def host_registered(state: MasterState, event: happened.HostRegistered, now: float) -> None:
    """Register a host, unless a live slave has its name."""
    description = event.description
    fault = description_fault(description) or _no_room(state, description)
    if fault:
        raise _refusal(state, event, fault, "invalid", now)
    known = state.hosts.by_name.get(description.name)
    if known is not None and known.description.incarnation == description.incarnation:
        _registered_again(state, known, event, now)
        return
    taken = _name_taken(state, known, event)
    if taken:
        raise _refusal(state, event, taken, "name_taken", now)
    labels = None if known is None or not known.has_labels else known.description.labels
    host = state.hosts.register(description, now)
    state.link_queries.begin(host.name, now)
    host.failing.clear()  # the slave reports the plugins that fail in this run
    state.ahead_since.pop(host.column, None)
    state.note_report(host)
    state.rebalancing.joined_at = now
    if labels != description.labels:
        save_host(state, host)
    state.record(
        now, EventKind.HOST_REGISTERED, f"{host.name} registered with {_live(event.instances)}",
        host=host.name,
        facts={
            "host_id": host.host_id, "labels": dict(description.labels),
            "resources": {r.name: r.capacity for r in description.resources},
            "absent": dict(description.absent), "devices": to_plain(description.devices),
        },
    )  # fmt: skip
    note_seen(state, host.name, event.journal_seen, now)
    replication.note_states(state, host, event.snapshots, now)  # replicas decide on placement
    loss.mark_rejoined(state, host, now)
    stopping = [instance for instance in state.instances_of(host) if instance.stopping]
    lifecycle.reconcile(state, host, event.instances, now, registering=True)
    for instance in stopping:  # the former run of the slave may not have carried out the order
        if instance.id.number in state.instances:
            lifecycle.stop_instance(state, instance, now)
    for instance in state.instances_of(host):  # restored before the host's capacities were known
        settle_reservation(state, instance, now)
        if instance.restarting is not None:
            instance.restarting.backoff = Backoff()  # the former run of the slave may have lost it
    _clear_exclusions(state, host)
    state.preemption.forget(host.name)
    for image in state.images.unwanted.values():
        if image.host == host.name:
            image.backoff = Backoff()
    _execute_again(state, host)
    reconsider_set_aside(state, now)
    state.emit(Reply(event.request, host_id=host.host_id))


def _no_room(state: MasterState, description: HostDescription) -> str:
    """Return why the table of hosts has no room for a host; "" if it has."""
    table, most = state.hosts, state.settings.max_hosts
    known = table.by_name.get(description.name)
    if (known is None or known.pruned) and len(table.listed()) >= most:
        return (
            f"{description.name} is not registered: the master knows {most} hosts, which is "
            f"`max_hosts`. Remove hosts that left by `rosrm prune`, or raise `max_hosts`"
        )
    new = {resource.name for resource in description.resources}.difference(table.resources)
    if len(table.resources) + len(new) > _MOST_RESOURCES:
        return (
            f"{description.name} is not registered: the hosts of a cluster have at most "
            f"{_MOST_RESOURCES} different resources, and {listed(sorted(new))} would be more"
        )
    return ""


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
    if known is not None:  # a slave whose name is taken retries for a moment
        state.record_seldom(known, EventKind.HOST_REFUSED, now, why)
    elif now - state.stranger_refused_at >= RECORD_PERIOD:  # strangers may have any number of names
        state.stranger_refused_at = now
        state.record(now, EventKind.HOST_REFUSED, why, host=event.description.name)
    return RequestRefused(why, code)


def _registered_again(
    state: MasterState, host: Host, event: happened.HostRegistered, now: float
) -> None:
    """Answer a repeated registration: the first answer was lost, or the request arrived twice.

    All later reports of the slave count. The instances in this request may be outdated, so the
    master orders a full report in sequence.
    """
    state.hosts.last_contact[host.column] = now
    note_devices(state, host, event.description.devices, now)
    replication.note_states(state, host, event.snapshots, now)
    changed = state.hosts.redescribe(host, event.description)
    if changed:
        _take_changes(state, host, changed, now)
    condition = state.hosts.condition_of(host)
    if condition in (HostCondition.LOST, HostCondition.SUSPECT):
        mark_up(state, host, now)
    if condition is not HostCondition.LOST:
        state.ask_for_report(host, now)
    state.emit(Reply(event.request, host_id=host.host_id))


def _take_changes(state: MasterState, host: Host, changed: Sequence[str], now: float) -> None:
    """Record what a slave describes in another way, and consider the queue again."""
    described = host.description
    if "labels" in changed:
        save_host(state, host)
    if "resources" in changed:  # the reservations are fractions of the former capacities
        for instance in state.instances_of(host):
            settle_reservation(state, instance, now)
    labels, resources = dict(described.labels), {r.name: r.capacity for r in described.resources}
    shown = {
        "labels": ", ".join(f"{key}={value}" for key, value in labels.items()),
        "resources": ", ".join(resources),
        "absent": ", ".join(described.absent),
        "launchers": ", ".join(described.launchers),
    }
    changes = "; ".join(f"{_CHANGES[name]}: {shown[name] or 'none'}" for name in changed)
    facts = {"labels": labels, "resources": resources, "absent": dict(described.absent)}
    state.record(
        now, EventKind.HOST_CHANGED, f"{host.name} has other {changes}", host=host.name,
        facts=facts,
    )  # fmt: skip
    reconsider_set_aside(state, now)


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
        process.moves.forget(host.name)
        if (process.excluded or process.failed_on) and not process.phase.is_terminal:
            _clear_exclusion(process, host)


def _clear_exclusion(process: Process, host: Host) -> None:
    """Clear the exclusion of a host, unless the process failed there in this run of its slave."""
    process.refusals.forget(host.name)
    if process.excluded.pop(host.name, None) is not None:
        process.demand = None
    failure = process.failed_on.get(host.name)
    if failure is not None and failure.incarnation != host.description.incarnation:
        del process.failed_on[host.name]
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
    """Persist the desired state of a host, and its labels, by which neighbour rules refer to it."""
    desired = {"host_id": host.host_id, "cordoned": host.cordoned, "draining": host.draining}
    labels = {"labels": dict(host.description.labels)} if host.has_labels else {}
    state.emit(Intent("host", host.name, {**desired, **labels}))


def host_left(state: MasterState, event: happened.HostLeft, now: float) -> None:
    """Handle the stop of a slave.

    Processes that the slave ends return to the queue; a slave that leaves them running is detached.
    """
    host = state.hosts.find(event.host_id, event.incarnation)
    if host is None:
        raise RequestRefused("this host is not registered", "unknown")
    host.left_since = now
    if event.left_running:
        _detach(state, host, event.left_running, now)
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


def _detach(
    state: MasterState, host: Host, running: tuple[InstanceStatus, ...], now: float
) -> None:
    """Detach a host: adopt the reported instances; an instance not reported has not begun."""
    state.hosts.set_condition(host, HostCondition.DETACHED)
    state.record(
        now, EventKind.HOST_DETACHED,
        f"{host.name} is detached: its slave was stopped and left {_live(running)} running",
        host=host.name,
    )  # fmt: skip
    lifecycle.reconcile(state, host, running, now, registering=True)
    loss.detach(state, host, lease_end(state, host), now)


def review_departures(state: MasterState, now: float) -> None:
    """Undo the departure of every host whose slave still accepts work: another sent its `leave`.

    A slave that stops accepts no work from before its own `leave` on.
    """
    table = state.hosts
    departed = table.having((HostCondition.LEFT, HostCondition.DETACHED))
    for column in np.flatnonzero(departed & table.accepting):
        host = table.hosts[column]
        reports = not host.pruned and table.last_contact[column] - host.left_since >= _STILL_THERE
        if reports:
            _undo_departure(state, host, now)


def _undo_departure(state: MasterState, host: Host, now: float) -> None:
    state.hosts.set_condition(host, HostCondition.UP)
    state.record(
        now, EventKind.HOST_BACK,
        f"{host.name} has not left: its slave still accepts work, and another sent its `leave`",
        host=host.name,
    )  # fmt: skip
    for instance in state.instances_of(host):
        process = state.owned_by(instance)
        if process is not None and process.wanted is DesiredState.REQUEUE and not instance.stopping:
            process.wanted = DesiredState.RUN
            state.save(process)
    loss.mark_rejoined(state, host, now)
    state.ask_for_report(host, now)
    reconsider_set_aside(state, now)


def process_requested(state: MasterState, event: happened.ProcessRequested, now: float) -> None:
    """Note the open request of a host; assignments follow when there is work."""
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
                f"a reading of {host.name} was refused (NaN, negative, absurd, a limit outside "
                f"0..1, or far ahead): usage {_shown(event.usage[row])}, limit "
                f"{_shown(event.limit[row])}, sequence {event.sequence[row]}"
            )
            state.record_seldom(host, EventKind.READING_REFUSED, now, fault)


def _shown(values: FloatArray) -> str:
    return "[" + ", ".join(f"{value:.3g}" for value in values[:8]) + ", …]"


def usages_received(state: MasterState, event: happened.UsagesReceived, now: float) -> None:
    """Lower reservations by the usage that readings now show."""
    host = state.hosts.find(event.host_id, event.incarnation)
    if host is None:
        return
    columns = {"cpu": event.cpu, "memory": event.memory}
    resources = host.description.resources
    for slot, amounts in event.others.items():
        if slot >= len(resources) or resources[slot].name in columns:
            fault = f"usages of {host.name} were refused: slot {slot} is not of another resource"
            state.record_seldom(host, EventKind.READING_REFUSED, now, fault)
            return
        columns[resources[slot].name] = amounts
    for number, *used in zip(event.numbers, *columns.values(), strict=True):
        instance = state.instances.get(int(number))
        if instance is not None and instance.host is host:
            _take_usage(state, instance, dict(zip(columns, map(float, used), strict=True)), now)


def _take_usage(state: MasterState, instance: Instance, used: dict[str, float], now: float) -> None:
    """Take the usage of an instance, in base units by resource."""
    host = instance.host
    if not all(is_plausible(resource, amount) for resource, amount in used.items()):
        fault = f"a usage of {instance.id} was refused (NaN, negative or absurd)"
        state.record_seldom(host, EventKind.READING_REFUSED, now, fault)
        return
    instance.seen = used
    for resource, amount in used.items():
        if resource in host.attributed:
            instance.peak[resource] = max(amount, instance.peak.get(resource, 0.0))
    settle_reservation(state, instance, now)


def peer_refused(state: MasterState, event: happened.PeerRefused, now: float) -> None:
    """Record a message that was refused at the network edge."""
    state.record(now, EventKind.PEER_REFUSED, f"{event.who} was refused: {event.reason}")


def key_revoked(state: MasterState, event: happened.KeyRevoked, now: float) -> None:
    """Give a host no more work: its slave could not fetch the assignment."""
    host = state.hosts.find(event.host_id, event.incarnation)
    if host is not None:
        state.hosts.withdraw_request(host)
        state.record(
            now, EventKind.PEER_REFUSED,
            f"host:{host.name} was refused: its key was revoked; its messages are dropped",
            host=host.name,
        )  # fmt: skip
