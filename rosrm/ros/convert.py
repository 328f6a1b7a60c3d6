"""Conversion message <-> value. Nothing received is unpickled; free-form values travel as JSON."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from typing import Any, Final

from rosrm.errors import Refused
from rosrm.model import values
from rosrm.model.rows import EventRow, HostRow, PluginRow, ProcessRow, ResourceRow
from rosrm_msgs import msg

_INFINITE: Final = float("inf")

# --- pairs, instances, JSON -------------------------------------------------------------------


def pairs(values: Mapping[str, Any]) -> list[msg.KeyValue]:
    """Return a mapping of strings as messages."""
    return [msg.KeyValue(key=key, value=str(value)) for key, value in values.items()]


def mapping(values: Iterable[msg.KeyValue]) -> dict[str, str]:
    """Return the mapping in messages; the inverse of `pairs`."""
    return {pair.key: pair.value for pair in values}


def instance_to_msg(instance: values.InstanceId) -> msg.InstanceId:
    """Return an instance as a message."""
    return msg.InstanceId(process=instance.process, number=instance.number)


def instance_from_msg(message: msg.InstanceId) -> values.InstanceId:
    """Return the inverse of `instance_to_msg`."""
    return values.InstanceId(message.process, message.number)


def json_object(text: str, what: str) -> dict[str, Any]:
    """Return the JSON object in a received text; raises `Refused` naming `what`."""
    if not text:
        return {}
    value = _json_value(text, what)
    if not isinstance(value, dict):
        raise Refused(f"{what} is a JSON {type(value).__name__}, not an object")
    return value


# --- specs and assignments --------------------------------------------------------------------


def spec_to_msg(spec: values.ProcessSpec) -> msg.ProcessSpec:
    """Return a process spec as a message."""
    restart, readiness, stop = spec.restart, spec.readiness, spec.stop
    return msg.ProcessSpec(
        name=spec.name, ros_namespace=spec.namespace, package=spec.package or "",
        executable=spec.executable or "", module=spec.module or "", command=list(spec.command),
        arguments=list(spec.arguments),
        parameters=[
            msg.KeyValue(key=key, value=json.dumps(value)) for key, value in spec.parameters.items()
        ],
        remappings=pairs(spec.remappings), environment=pairs(spec.environment),
        working_directory=spec.working_directory or "", ros=spec.ros, kind=spec.kind.value,
        restart=restart_to_msg(restart),
        needs=[
            msg.ResourceAmount(resource=name, amount=float(amount))
            for name, amount in spec.needs.items()
        ],
        required_labels=pairs(spec.required_labels), preferred_labels=pairs(spec.preferred_labels),
        avoided_labels=pairs(spec.avoided_labels), priority=spec.priority,
        migration=msg.MigrationPolicy(
            strategy=spec.migration.strategy or "", overlap=spec.migration.overlap,
            options=json.dumps(dict(spec.migration.options)),
        ),
        readiness=msg.Readiness(kind=readiness.kind, timeout=float(readiness.timeout)),
        stop=msg.StopPolicy(
            interrupt_grace=float(stop.interrupt_grace), terminate_grace=float(stop.terminate_grace)
        ),
        host_loss=msg.HostLossPolicy(
            then=spec.host_loss.then, delay=float(spec.host_loss.delay)
        ),
        isolation=msg.IsolationPolicy(
            then=spec.isolation.then, after=float(spec.isolation.after)
        ),
        standby=msg.StandbyPolicy(
            wanted=spec.standby.wanted, apart_by=list(spec.standby.apart_by)
        ),
        health=msg.Health(
            topic=spec.health.topic, rate=float(spec.health.rate),
            lifecycle=spec.health.lifecycle, timeout=float(spec.health.timeout),
        ),
    )  # fmt: skip


def spec_from_msg(message: msg.ProcessSpec) -> values.ProcessSpec:
    """Return the inverse of `spec_to_msg`; raises `Refused` for an invalid spec."""
    fault = _spec_fault(message)
    if fault:
        raise Refused(f"process {message.name!r}: {fault}")
    migration = message.migration
    return values.ProcessSpec(
        name=message.name, namespace=message.ros_namespace, package=message.package or None,
        executable=message.executable or None, module=message.module or None,
        command=tuple(message.command), arguments=tuple(message.arguments),
        parameters={
            pair.key: _json_value(pair.value, f"parameter {pair.key}")
            for pair in message.parameters
        },
        remappings=mapping(message.remappings), environment=mapping(message.environment),
        working_directory=message.working_directory or None, ros=message.ros,
        kind=values.Kind(message.kind),
        restart=_restart_from_msg(message.restart),
        needs={need.resource: need.amount for need in message.needs},
        required_labels=mapping(message.required_labels),
        preferred_labels=mapping(message.preferred_labels),
        avoided_labels=mapping(message.avoided_labels), priority=message.priority,
        migration=values.MigrationPolicy(
            migration.strategy or None, migration.overlap,
            json_object(migration.options, "migration options"),
        ),
        readiness=values.Readiness(message.readiness.kind, message.readiness.timeout),
        stop=values.StopPolicy(message.stop.interrupt_grace, message.stop.terminate_grace),
        host_loss=values.HostLossPolicy(message.host_loss.then, message.host_loss.delay),
        isolation=values.IsolationPolicy(message.isolation.then, message.isolation.after),
        standby=values.StandbyPolicy(message.standby.wanted, tuple(message.standby.apart_by)),
        health=values.Health(
            message.health.topic, message.health.rate, message.health.lifecycle,
            message.health.timeout,
        ),
    )  # fmt: skip


def _spec_fault(message: msg.ProcessSpec) -> str:
    """Return a fault that rosrm's own clients would not send, though others might; "": none."""
    forms = [bool(message.package), bool(message.module), bool(message.command)]
    if not message.name:
        return "it has no name"
    if sum(forms) != 1:
        return "give exactly one of package + executable, module, command"
    if bool(message.package) != bool(message.executable):
        return "package and executable go together"
    fault = _word_fault(message)
    if fault:
        return fault
    for need in message.needs:
        if not 0.0 <= need.amount < _INFINITE:
            return f"it needs {need.amount} of {need.resource}; allowed: 0 and more"
    return _times_fault(message)


def _word_fault(message: msg.ProcessSpec) -> str:
    words = (
        ("kind", message.kind, tuple(kind.value for kind in values.Kind)),
        ("readiness", message.readiness.kind, ("auto", "graph", "running")),
        ("host_loss", message.host_loss.then, ("wait", "elsewhere", "stop")),
        ("isolation", message.isolation.then, ("keep", "stop")),
    )
    for name, given, allowed in words:
        if given not in allowed:
            return f"{name} {given!r}; allowed: {', '.join(allowed)}"
    return ""


def _times_fault(message: msg.ProcessSpec) -> str:
    """Return an invalid time: a wait that is no number would never end, or never begin."""
    fault = _restart_fault(message.restart)
    if fault:
        return fault
    times = {
        "readiness.timeout": message.readiness.timeout,
        "stop.interrupt_grace": message.stop.interrupt_grace,
        "stop.terminate_grace": message.stop.terminate_grace,
        "host_loss.delay": message.host_loss.delay,
        "isolation.after": message.isolation.after,
        "health.rate": message.health.rate,
        "health.timeout": message.health.timeout,
    }
    for name, seconds in times.items():
        if not 0.0 <= seconds < _INFINITE:
            return f"{name} is {seconds}; allowed: 0 and more"
    return ""


def restart_to_msg(restart: values.RestartPolicy) -> msg.RestartPolicy:
    """Return a restart policy as a message."""
    return msg.RestartPolicy(
        when=restart.when, delay=float(restart.delay), max_delay=float(restart.max_delay),
        factor=float(restart.factor), attempts=restart.attempts, window=float(restart.window),
    )  # fmt: skip


def restart_from_msg(message: msg.RestartPolicy) -> values.RestartPolicy:
    """Return the inverse of `restart_to_msg`; raises `Refused` for an invalid policy."""
    fault = _restart_fault(message)
    if fault:
        raise Refused(f"a restart policy: {fault}")
    return _restart_from_msg(message)


def _restart_from_msg(message: msg.RestartPolicy) -> values.RestartPolicy:
    return values.RestartPolicy(
        message.when, message.delay, message.max_delay, message.factor, message.attempts,
        message.window,
    )  # fmt: skip


def _restart_fault(message: msg.RestartPolicy) -> str:
    if message.when not in ("never", "on-failure", "always"):
        return f"restart {message.when!r}; allowed: never, on-failure, always"
    if not 1.0 <= message.factor < _INFINITE:
        return f"the factor of its restarts is {message.factor}; allowed: 1 and more"
    for name in ("delay", "max_delay", "window"):
        if not 0.0 <= getattr(message, name) < _INFINITE:
            return f"restart.{name} is {getattr(message, name)} s; allowed: 0 and more"
    return ""


def _json_value(text: str, what: str) -> Any:
    try:
        return json.loads(text)
    except (ValueError, RecursionError) as error:
        raise Refused(f"{what} is no JSON: {error}") from error


def assignment_to_msg(assignment: values.Assignment) -> msg.Assignment:
    """Return an order to run an instance as a message."""
    fence = assignment.fence or values.Fence(0.0, 0.0)
    return msg.Assignment(
        instance=instance_to_msg(assignment.instance), epoch=assignment.epoch,
        node_name=assignment.node_name, shadow=assignment.shadow,
        fence_after=float(fence.after), fence_grace=float(fence.grace),
        fence_alive=fence.alive,
        kept_on=list(assignment.kept_on), kept_from=assignment.kept_from,
        restored=assignment.restored,
        spec=spec_to_msg(assignment.spec),
    )  # fmt: skip


def assignment_from_msg(message: msg.Assignment) -> values.Assignment:
    """Return the inverse of `assignment_to_msg`; raises `Refused`."""
    for name in ("fence_after", "fence_grace"):
        if not 0.0 <= getattr(message, name) < _INFINITE:
            raise Refused(f"{message.instance.process}: {name} is {getattr(message, name)}")
    fence = None
    if message.fence_after:
        fence = values.Fence(message.fence_after, message.fence_grace, message.fence_alive)
    return values.Assignment(
        instance_from_msg(message.instance), spec_from_msg(message.spec), message.epoch,
        message.node_name, message.shadow, fence, tuple(message.kept_on), message.kept_from,
        message.restored,
    )  # fmt: skip


# --- hosts and statuses -----------------------------------------------------------------------


def host_to_msg(host: values.HostDescription) -> msg.HostDescription:
    """Return a host's description as a message."""
    return msg.HostDescription(
        name=host.name, hostname=host.hostname, incarnation=host.incarnation, pid=host.pid,
        software_version=host.software_version, labels=pairs(host.labels),
        resources=[
            msg.ResourceDescription(
                slot=slot, name=resource.name, unit=resource.unit, capacity=resource.capacity,
                scope=resource.scope,
            )
            for slot, resource in enumerate(host.resources)
        ],
        max_processes=host.max_processes, period=host.period, executors=list(host.executors),
        absent=pairs(host.absent),
    )  # fmt: skip


def host_from_msg(message: msg.HostDescription) -> values.HostDescription:
    """Return the inverse of `host_to_msg`; raises `Refused` for an invalid host."""
    resources = sorted(message.resources, key=lambda resource: int(resource.slot))
    if [resource.slot for resource in resources] != list(range(len(resources))):
        raise Refused(f"host {message.name!r}: its resources do not fill the slots 0, 1, 2, …")
    if len(resources) > values.RESOURCE_SLOTS or not message.name or not message.incarnation:
        raise Refused(f"host {message.name!r}: no name, no incarnation or too many resources")
    for resource in resources:
        if not 0.0 < resource.capacity < _INFINITE:
            raise Refused(
                f"host {message.name!r}: {resource.name} has capacity {resource.capacity}"
            )
    if not 0.0 < message.period < _INFINITE:
        raise Refused(f"host {message.name!r}: it reports every {message.period} s")
    return values.HostDescription(
        name=message.name, incarnation=message.incarnation, hostname=message.hostname,
        pid=message.pid, software_version=message.software_version, labels=mapping(message.labels),
        resources=tuple(
            values.ResourceDescription(r.name, r.unit, r.capacity, r.scope) for r in resources
        ),
        max_processes=message.max_processes, period=message.period,
        executors=tuple(message.executors), absent=mapping(message.absent),
    )  # fmt: skip


def status_to_msg(status: values.InstanceStatus) -> msg.ProcessStatus:
    """Return an instance's status as a message."""
    return msg.ProcessStatus(
        instance=instance_to_msg(status.instance), state=status.state.value, pid=status.pid,
        exit_code=status.exit_code, exit_signal=status.exit_signal, restarts=status.restarts,
        peak_memory=float(status.peak_memory), cpu_time=float(status.cpu_time),
        run_time=float(status.run_time), message=status.message,
    )  # fmt: skip


def status_from_msg(message: msg.ProcessStatus) -> values.InstanceStatus:
    """Return the inverse of `status_to_msg`; raises `Refused` for an invalid status."""
    try:
        state = values.InstanceState(message.state)
    except ValueError as error:
        raise Refused(f"unknown state {message.state!r} of {message.instance.process}") from error
    for name in ("peak_memory", "cpu_time", "run_time"):
        if not 0.0 <= getattr(message, name) < _INFINITE:
            raise Refused(f"{message.instance.process}: {name} is {getattr(message, name)}")
    return values.InstanceStatus(
        instance_from_msg(message.instance), state, message.pid, message.exit_code,
        message.exit_signal, message.restarts, message.peak_memory, message.cpu_time,
        message.run_time, message.message,
    )  # fmt: skip


def kept_to_msg(kept: values.KeptState) -> msg.KeptState:
    """Return the description of a snapshot on a host as a message."""
    return msg.KeptState(
        process=kept.instance.process, number=kept.instance.number, sequence=kept.sequence,
        size=kept.size,
    )  # fmt: skip


def kept_from_msg(message: msg.KeptState) -> values.KeptState:
    """Return the inverse of `kept_to_msg`."""
    instance = values.InstanceId(message.process, message.number)
    return values.KeptState(instance, message.sequence, message.size)


# --- rows -------------------------------------------------------------------------------------


def host_row_to_msg(row: HostRow) -> msg.HostState:
    """Return a row of `rosrm hosts` as a message."""
    return msg.HostState(
        description=host_to_msg(row.description), host_id=row.host_id, state=row.state,
        cordoned=row.cordoned, draining=row.draining, accepting=row.accepting,
        reading_age=row.reading_age, usage=[r.usage for r in row.resources],
        in_flight=[r.in_flight for r in row.resources], limit=[r.limit for r in row.resources],
        stale=[r.stale for r in row.resources], processes=row.processes, drained=row.drained,
    )  # fmt: skip


def _fraction(value: float) -> float:
    """Return a number that travelled as float32, without digits beyond float32's precision."""
    return round(float(value), 6)


def host_row_from_msg(message: msg.HostState) -> HostRow:
    """Return the inverse of `host_row_to_msg`."""
    resources = tuple(
        ResourceRow(
            resource.name, resource.unit, resource.capacity, resource.scope, _fraction(usage),
            _fraction(in_flight), _fraction(limit), bool(stale),
        )
        for resource, usage, in_flight, limit, stale in zip(
            message.description.resources, message.usage, message.in_flight, message.limit,
            message.stale, strict=True,
        )
    )  # fmt: skip
    description = message.description
    return HostRow(
        values.HostDescription(
            description.name, description.incarnation, description.hostname, description.pid,
            description.software_version, mapping(description.labels),
            tuple(values.ResourceDescription(r.name, r.unit, r.capacity, r.scope)
                  for r in description.resources),
            description.max_processes, description.period, tuple(description.executors),
            mapping(description.absent),
        ),
        message.host_id, message.state, message.cordoned, message.draining, message.accepting,
        message.reading_age, resources, message.processes, message.drained,
    )  # fmt: skip


def process_row_to_msg(row: ProcessRow) -> msg.ProcessState:
    """Return a row of `rosrm ps` as a message."""
    fields = {name: getattr(row, name) for name in ProcessRow.__slots__}
    known = row.exit_code is not None
    return msg.ProcessState(**fields | {"exit_code": row.exit_code or 0, "exit_code_known": known})


def process_row_from_msg(message: msg.ProcessState) -> ProcessRow:
    """Return the inverse of `process_row_to_msg`."""
    fields = {name: getattr(message, name) for name in ProcessRow.__slots__}
    fields["cpu"] = _fraction(message.cpu)
    return ProcessRow(**fields if message.exit_code_known else fields | {"exit_code": None})


def plugin_row_to_msg(row: PluginRow) -> msg.PluginState:
    """Return a row of `rosrm plugins` as a message."""
    return msg.PluginState(**{name: getattr(row, name) for name in PluginRow.__slots__})


def plugin_row_from_msg(message: msg.PluginState) -> PluginRow:
    """Return the inverse of `plugin_row_to_msg`."""
    return PluginRow(**{name: getattr(message, name) for name in PluginRow.__slots__})


def event_to_msg(row: EventRow) -> msg.Event:
    """Return a line of the event record as a message."""
    return msg.Event(
        sequence=row.sequence, wall_time=row.wall_time, elapsed=row.elapsed, kind=row.kind,
        process=row.process, host=row.host, message=row.message, data=json.dumps(dict(row.facts)),
    )  # fmt: skip


def event_from_msg(message: msg.Event) -> EventRow:
    """Return the inverse of `event_to_msg`."""
    return EventRow(
        message.sequence, message.wall_time, message.elapsed, message.kind, message.process,
        message.host, message.message, json_object(message.data, "an event"),
    )  # fmt: skip
