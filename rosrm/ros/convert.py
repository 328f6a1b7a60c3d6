"""Conversion message <-> value. Nothing received is unpickled; free-form values travel as JSON."""

from __future__ import annotations

import json
from array import array
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import MISSING, Field, fields, is_dataclass, replace
from functools import cache, partial
from operator import attrgetter
from typing import Any, Final, NamedTuple, TypeVar, get_args, get_origin, get_type_hints

from rosrm.errors import Refused
from rosrm.keys.derivation import KEY_BYTES
from rosrm.model import values
from rosrm.model.adoption_rules import adoption_fault
from rosrm.model.applications import OnFailure, RolloutPolicy, Target
from rosrm.model.artifacts import Artifact, artifacts_fault, contents_fault
from rosrm.model.component_rules import components_fault
from rosrm.model.container_rules import container_fault
from rosrm.model.description_checks import (
    description_fault,
    is_namespace,
    is_node_name,
    is_resource_name,
    name_fault,
    node_name_fault,
    other_process_fault,
)
from rosrm.model.devices import (
    Device,
    DeviceNeed,
    HeldDevice,
    device_fault,
    held_fault,
    need_fault,
)
from rosrm.model.durations import LONGEST
from rosrm.model.job_checks import job_fault
from rosrm.model.lifecycle_rules import lifecycle_fault
from rosrm.model.limits import limits_fault
from rosrm.model.modes import Mode, Trigger
from rosrm.model.parameters import pattern_fault
from rosrm.model.remembered import remembered
from rosrm.model.rows import EventRow, HostRow, PluginRow, ProcessRow, ResourceRow
from rosrm.model.secret_rules import secrets_fault
from rosrm.model.stop_rules import stop_fault
from rosrm.ros.bounds import MOST_LETTERS
from rosrm.ros.cdr import made
from rosrm.wording import sanitized, sendable
from rosrm_msgs import msg

#: Greatest amount of a resource that a process may need, in base units.
_MOST_NEEDED: Final = 1e18
#: Greatest factor by which the delay of restarts may grow.
_MOST_GROWTH: Final = 1e6
#: Greatest rate of a topic, in Hz.
_MOST_RATE: Final = 1e6
#: Greatest values in the status of an instance, in base units.
_MOST_REPORTED: Final = {
    "peak_memory": values.MOST_USED["memory"],
    "cpu_time": LONGEST * values.MOST_USED["cpu"],
    "run_time": LONGEST,
}
_STATES: Final = frozenset(state.value for state in values.InstanceState)

# --- pairs, instances, JSON -------------------------------------------------------------------


def pairs(values: Mapping[str, Any]) -> list[msg.KeyValue]:
    """Return a mapping of strings as messages."""
    if not values:
        return []
    return [made(msg.KeyValue, key=key, value=str(value)) for key, value in values.items()]


def mapping(values: Iterable[msg.KeyValue]) -> dict[str, str]:
    """Return the mapping in messages; the inverse of `pairs`."""
    return {pair.key: pair.value for pair in values}


def instance_to_msg(instance: values.InstanceId) -> msg.InstanceId:
    """Return an instance as a message."""
    return _to_msg(msg.InstanceId, instance)


def instance_from_msg(message: msg.InstanceId) -> values.InstanceId:
    """Return the inverse of `instance_to_msg`."""
    return _from_msg(values.InstanceId, message)


def json_object(text: str, what: str) -> dict[str, Any]:
    """Return the JSON object in a received text; raises `Refused` naming `what`."""
    if not text:
        return {}
    value = _json_value(text, what)
    if not isinstance(value, dict):
        raise Refused(f"{what} is a JSON {type(value).__name__}, not an object")
    return value


# --- values and messages with the same fields -------------------------------------------------

_Value = TypeVar("_Value")
_Convert = Callable[[Any], Any]

#: Fields that have another name in messages.
_RENAMED: Final = {"namespace": "ros_namespace", "facts": "data", "array": "job_array"}
#: Type of a field to its conversion to a message and back.
_FORMS: Final[Mapping[Any, tuple[_Convert, _Convert]]] = {
    float: (float, float),
    str | None: (lambda text: text or "", lambda text: text or None),
    tuple[str, ...]: (list, tuple),
    tuple[int, ...]: (list, lambda numbers: tuple(map(int, numbers))),
    Mapping[str, str]: (pairs, mapping),
    Mapping[str, values.StartCondition]: (pairs, mapping),
    # Not `value`, which is a property, and so slower.
    values.Kind: (attrgetter("_value_"), values.Kind),
    values.InstanceState: (attrgetter("_value_"), values.InstanceState),
}


class _Field(NamedTuple):
    """A field of a dataclass and of its message.

    Attributes:
        name: in the dataclass.
        sent_as: in messages.
        slot: attribute of messages with its value. The property `sent_as` is slower.
        to_msg: converts its value to that in messages.
        from_msg: the inverse of `to_msg`.
        is_default_empty: True if the default of the field is 0, False or empty, or None for a text.
            Then an empty value in a message need not be converted.
    """

    name: str
    sent_as: str
    slot: str
    to_msg: _Convert
    from_msg: _Convert
    is_default_empty: bool


def _fields(kind: Any) -> tuple[_Field, ...]:
    """Return the fields of a dataclass."""
    found, hints = [], get_type_hints(kind)
    for field in fields(kind):
        name, hint = field.name, hints[field.name]
        sent_as = _RENAMED.get(name, name)
        # Only the property converts numbers to an array.
        slot = sent_as if hint == tuple[int, ...] else f"_{sent_as}"
        found.append(_Field(name, sent_as, slot, *_forms(hint), _is_default_empty(field, hint)))
    return tuple(found)


def _is_default_empty(field: Field[Any], hint: Any) -> bool:
    made = field.default if field.default_factory is MISSING else field.default_factory()
    return not made and (made is not None or hint == str | None)


#: Typed, because mypy does not accept a type as an argument of a cache.
_known_fields: Final[Callable[[Any], tuple[_Field, ...]]] = cache(_fields)


def _forms(hint: Any) -> tuple[_Convert, _Convert]:
    if isinstance(hint, type) and is_dataclass(hint):
        to_msg, from_msg = _dataclass_forms(hint)
        # A user may change a mapping between two submissions, so its message is not cached.
        is_fixed = all(get_origin(one) is not Mapping for one in get_type_hints(hint).values())
        return remembered(to_msg) if is_fixed else to_msg, remembered(from_msg)
    inner = get_args(hint)[0] if get_origin(hint) is tuple else None
    if isinstance(inner, type) and is_dataclass(inner) and hasattr(msg, inner.__name__):
        to_msg, from_msg = _dataclass_forms(inner)
        return (
            lambda items: [to_msg(item) for item in items],
            lambda items: tuple(from_msg(item) for item in items),
        )
    return _FORMS.get(hint, (_unchanged, _unchanged))


def _dataclass_forms(kind: Any) -> tuple[_Convert, _Convert]:
    return partial(_to_msg, getattr(msg, kind.__name__)), partial(_from_msg, kind)


def _unchanged(value: Any) -> Any:
    return value


def _to_msg(message: Any, value: Any, /, **others: Any) -> Any:
    """Return a dataclass as a message of a type with the same fields; `others` are converted."""
    converted = made(message, **others)
    for name, sent_as, slot, convert, _, _ in _known_fields(type(value)):
        if sent_as not in others:
            field = getattr(value, name)
            setattr(converted, slot, field if convert is _unchanged else convert(field))
    return converted


def _from_msg(wanted: type[_Value], message: Any, /, **others: Any) -> _Value:
    """Return the inverse of `_to_msg`."""
    same = {
        name: convert(value)
        for name, _, slot, _, convert, is_default_empty in _known_fields(wanted)
        if name not in others and ((value := getattr(message, slot)) or not is_default_empty)
    }
    return wanted(**same, **others)


# --- specs and assignments --------------------------------------------------------------------


def spec_to_msg(spec: values.ProcessSpec) -> msg.ProcessSpec:
    """Return a process spec as a message."""
    return _to_msg(
        msg.ProcessSpec, spec,
        parameters=_json_pairs(spec.parameters),
        components=[
            _to_msg(
                msg.Component, one, parameters=_json_pairs(one.parameters),
                arguments=_json_pairs(one.arguments),
            )
            for one in spec.components
        ],
        parameter_sources=[
            msg.ParameterSource(
                file=one.file, nodes=one.nodes, parameters=_json_pairs(one.parameters)
            )
            for one in spec.parameter_sources
        ],
        needs=_amounts_to_msg(spec.needs),
        migration=_to_msg(
            msg.MigrationPolicy, spec.migration, options=_json_text(spec.migration.options)
        ),
        talks_to=[
            msg.ProcessFlow(process=name, rate=float(rate)) for name, rate in spec.talks_to.items()
        ],
        artifacts=[
            msg.Artifact(name=one.name, digest=one.digest, size=one.size) for one in spec.artifacts
        ],
    )  # fmt: skip


def spec_from_msg(message: msg.ProcessSpec) -> values.ProcessSpec:
    """Return the inverse of `spec_to_msg`; raises `Refused` for an invalid spec.

    The caller must have checked the bounds of the message with `check_bounds`.
    """
    fault = _spec_fault(message)
    if fault:
        raise Refused(f"process {message.name!r:.60}: {fault}")
    spec = _from_msg(
        values.ProcessSpec, message,
        parameters=_parameters(message),
        components=tuple(
            _from_msg(
                values.Component, one, parameters=_json_values(one.parameters),
                arguments=_json_values(one.arguments),
            )
            for one in message.components
        ),
        parameter_sources=tuple(
            values.ParameterSource(one.file, one.nodes, _parameters(one))
            for one in message.parameter_sources
        ),
        needs={need.resource: need.amount for need in message.needs},
        migration=_from_msg(
            values.MigrationPolicy, message.migration,
            options=json_object(message.migration.options, "migration options"),
        ),
        talks_to={flow.process: flow.rate for flow in message.talks_to},
        artifacts=_artifacts(message),
    )  # fmt: skip
    checks = (
        limits_fault,
        stop_fault,
        job_fault,
        secrets_fault,
        container_fault,
        lifecycle_fault,
        components_fault,
        adoption_fault,
    )
    fault = next(filter(None, (check(spec) for check in checks)), "")
    if fault:
        raise Refused(f"process {message.name!r:.60}: {fault}")
    return spec


def _json_text(mapping: Mapping[str, Any]) -> str:
    return json.dumps(dict(mapping)) if mapping else "{}"


def _json_pairs(parameters: Mapping[str, Any]) -> list[msg.KeyValue]:
    return [msg.KeyValue(key=key, value=json.dumps(value)) for key, value in parameters.items()]


def _parameters(message: msg.ProcessSpec | msg.ParameterSource) -> dict[str, Any]:
    return _json_values(message.parameters)


def _json_values(pairs: Iterable[msg.KeyValue]) -> dict[str, Any]:
    return {pair.key: _json_value(pair.value, f"parameter {pair.key}") for pair in pairs}


def target_to_msg(
    target: Target, digests: Sequence[str] = (), sent: Iterable[int] | None = None
) -> msg.ApplicationTarget:
    """Return the desired state of an application as a message.

    Args:
        digests: of its specs; (): unknown.
        sent: positions of the specs that are sent; None: all.
    """
    specs = target.specs if sent is None else [target.specs[at] for at in sent]
    return msg.ApplicationTarget(
        application=target.application, version=target.version, digest=" ".join(digests),
        processes=[spec_to_msg(spec) for spec in specs],
        max_parallel=target.rollout.max_parallel,
        healthy_for=float(target.rollout.healthy_for), on_failure=target.rollout.on_failure,
    )  # fmt: skip


def target_from_msg(
    message: msg.ApplicationTarget, specs: tuple[values.ProcessSpec, ...]
) -> Target:
    """Return the inverse of `target_to_msg`; raises `Refused` for an invalid target.

    `specs`: its processes.
    """
    fault = name_fault(message.application, "application") or _rollout_fault(message)
    if fault:
        raise Refused(fault)
    rollout = RolloutPolicy(message.max_parallel, message.healthy_for, message.on_failure)
    return Target(message.application, specs, message.version, rollout)


def mode_to_msg(mode: Mode) -> msg.Mode:
    """Return a mode as a message."""
    return msg.Mode(
        name=mode.name, targets=[target_to_msg(one) for one in mode.targets],
        limits=_amounts_to_msg(mode.limits), weights=_amounts_to_msg(mode.weights),
        host_lost=mode.when.host_lost, over_limit=mode.when.over_limit,
        lasts=float(mode.when.lasts),
    )  # fmt: skip


def mode_from_msg(message: msg.Mode, targets: tuple[Target, ...]) -> Mode:
    """Return the inverse of `mode_to_msg`; raises `Refused` for an invalid mode.

    `targets`: its applications.
    """
    fault = name_fault(message.name, "mode") or _mode_fault(message)
    if fault:
        raise Refused(fault)
    return Mode(
        message.name, targets,
        {one.resource: one.amount for one in message.limits},
        {one.resource: one.amount for one in message.weights},
        Trigger(message.host_lost, message.over_limit, message.lasts),
    )  # fmt: skip


def _mode_fault(message: msg.Mode) -> str:
    mode = f"mode {message.name}"
    for what, amounts in (("limits", message.limits), ("weights", message.weights)):
        for one in amounts:
            if not 0.0 <= one.amount <= 1.0:
                return f"{mode}: {what}.{one.resource!r:.60} is {one.amount}; allowed: 0 to 1"
    if message.host_lost and message.over_limit:
        return f"{mode}: when: give a lost host or a limit, not both"
    if not 0.0 <= message.lasts <= LONGEST:
        return f"{mode}: when: lasts is {message.lasts}; allowed: 0 to {LONGEST:g} s"
    return ""


def _amounts_to_msg(amounts: Mapping[str, float]) -> list[msg.ResourceAmount]:
    return [
        msg.ResourceAmount(resource=name, amount=float(amount)) for name, amount in amounts.items()
    ]


def _rollout_fault(message: msg.ApplicationTarget) -> str:
    application, allowed = message.application, get_args(OnFailure)
    if message.max_parallel < 1:
        return f"{application}: max_parallel is {message.max_parallel}; allowed: 1 or more"
    if not 0.0 <= message.healthy_for <= LONGEST:
        return f"{application}: healthy_for is {message.healthy_for}; allowed: 0 to {LONGEST:g} s"
    if message.on_failure not in allowed:
        given = f"on_failure is {message.on_failure!r:.100}"
        return f"{application}: {given}; allowed: {', '.join(allowed)}"
    return ""


def _spec_fault(message: msg.ProcessSpec) -> str:
    """Return a fault that rosrm's own clients would not send, though others might; "": none."""
    fault = _name_fault(message)
    if fault:
        return fault
    forms = [bool(message.package), bool(message.module), bool(message.command)]
    if sum(forms) != 1:
        return "give exactly one of package + executable, module, command"
    if bool(message.package) != bool(message.executable):
        return "package and executable go together"
    return (
        _word_fault(message)
        or _needs_fault(message)
        or _times_fault(message)
        or _neighbours_fault(message)
        or _devices_fault(message)
        or _flows_fault(message)
        or _start_order_fault(message)
        or _names_fault(message)
        or _artifacts_fault(message)
    )


def _name_fault(message: msg.ProcessSpec) -> str:
    namespace = message.ros_namespace
    if namespace and not is_namespace(namespace):
        return f"{namespace!r:.250} is not an absolute namespace such as '/robot1'"
    if message.node_name and not is_node_name(message.node_name):
        return f"node_name: {node_name_fault(message.node_name)}"
    for source in message.parameter_sources:
        if not source.file and (fault := pattern_fault(source.nodes)):
            return f"parameters: {fault}"
    if message.application and (fault := name_fault(message.application, "application")):
        return fault
    return name_fault(message.name, "process")


def _names_fault(message: msg.ProcessSpec) -> str:
    """Return why the name of its group or gang is refused; "": they are valid, or not given."""
    for what, name in (("group", message.group.name), ("gang", message.together)):
        fault = name_fault(name, what) if name else ""
        if fault:
            return fault
    return ""


def _needs_fault(message: msg.ProcessSpec) -> str:
    for need in message.needs:
        if not is_resource_name(need.resource):
            return f"it needs {need.resource!r:.100}, which is no name of a resource"
        if not 0.0 <= need.amount <= _MOST_NEEDED:
            return f"it needs {need.amount} of {need.resource}; allowed: 0 to {_MOST_NEEDED:g}"
    return ""


def _neighbours_fault(message: msg.ProcessSpec) -> str:
    for rule in message.neighbours:
        if rule.relation not in get_args(values.Relation):
            allowed = ", ".join(get_args(values.Relation))
            return f"neighbours: {rule.relation!r:.100}; allowed: {allowed}"
        if bool(rule.processes) == bool(rule.group):
            return "neighbours: give either processes or a group"
        for name in rule.processes:
            fault = name_fault(name, "process")
            if fault:
                return f"neighbours: {fault}"
    return ""


def _devices_fault(message: msg.ProcessSpec) -> str:
    fault = need_fault(_from_msg(DeviceNeed, need) for need in message.devices)
    return f"devices: {fault}" if fault else ""


def _artifacts(message: msg.ProcessSpec) -> tuple[Artifact, ...]:
    return tuple(Artifact(one.name, one.digest, one.size) for one in message.artifacts)


def _artifacts_fault(message: msg.ProcessSpec) -> str:
    artifacts = _artifacts(message)
    fault = artifacts_fault(artifacts) or contents_fault(artifacts)
    return f"artifacts: {fault}" if fault else ""


def _held(message: msg.Assignment | msg.ProcessStatus) -> tuple[HeldDevice, ...]:
    """Return the devices of an instance; raises `Refused`."""
    held = tuple(_from_msg(HeldDevice, one) for one in message.devices)
    fault = held_fault(held)
    if fault:
        raise Refused(f"{message.instance.process!r:.250}: {fault}")
    return held


def _flows_fault(message: msg.ProcessSpec) -> str:
    for flow in message.talks_to:
        fault = other_process_fault(flow.process, message.name)
        if not fault and not 0.0 <= flow.rate <= values.LARGEST_RATE:
            allowed = f"0 to {values.LARGEST_RATE:g}"
            fault = f"{flow.rate} B/s with {flow.process}; allowed: {allowed}"
        if fault:
            return f"talks_to: {fault}"
    return ""


def _start_order_fault(message: msg.ProcessSpec) -> str:
    allowed = get_args(values.StartCondition)
    for pair in message.start_order.after:
        fault = other_process_fault(pair.key, message.name)
        if not fault and pair.value not in allowed:
            fault = f"{pair.key} {pair.value!r:.100}; allowed: {', '.join(allowed)}"
        if fault:
            return f"after: {fault}"
    return ""


#: Allowed words of each field, by its name in messages to the user.
_WORDS: Final[Mapping[str, tuple[Callable[[Any], str], tuple[str, ...]]]] = {
    "kind": (attrgetter("kind"), tuple(kind.value for kind in values.Kind)),
    "readiness": (attrgetter("readiness.kind"), get_args(values.ReadinessKind)),
    "host_loss": (attrgetter("host_loss.then"), get_args(values.HostLossAction)),
    "isolation": (attrgetter("isolation.then"), get_args(values.IsolationAction)),
    "after.on_restart": (
        attrgetter("start_order.on_restart"), get_args(values.DependencyRestartAction)
    ),
    "group.ends": (attrgetter("group.ends"), get_args(values.GroupEnd)),
    "lifecycle": (attrgetter("lifecycle.autostart"), get_args(values.Autostart)),
}  # fmt: skip


def _word_fault(message: msg.ProcessSpec) -> str:
    for name, (given_in, allowed) in _WORDS.items():
        given = given_in(message)
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
        "health.timeout": message.health.timeout,
        "lifecycle.timeout": message.lifecycle.timeout,
        "reschedule.delay": message.reschedule.delay,
        "time_limit": message.time_limit,
        "after.delay": message.start_order.delay,
    }
    for name, seconds in times.items():
        if not 0.0 <= seconds <= LONGEST:
            return f"{name} is {seconds}; allowed: 0 to {LONGEST:g}"
    if not 0.0 <= message.health.rate <= _MOST_RATE:
        return f"health.rate is {message.health.rate}; allowed: 0 to {_MOST_RATE:g}"
    return ""


def restart_to_msg(restart: values.RestartPolicy) -> msg.RestartPolicy:
    """Return a restart policy as a message."""
    return _to_msg(msg.RestartPolicy, restart)


def restart_from_msg(message: msg.RestartPolicy) -> values.RestartPolicy:
    """Return the inverse of `restart_to_msg`; raises `Refused` for an invalid policy."""
    fault = _restart_fault(message)
    if fault:
        raise Refused(f"a restart policy: {fault}")
    return _from_msg(values.RestartPolicy, message)


def limits_to_msg(limits: values.Limits) -> msg.Limits:
    """Return limits as a message."""
    return _to_msg(msg.Limits, limits)


def limits_from_msg(message: msg.Limits) -> values.Limits:
    """Return the inverse of `limits_to_msg`; raises `Refused` for impossible limits."""
    limits = _from_msg(values.Limits, message)
    fault = limits_fault(values.ProcessSpec("", limits=limits))
    if fault:
        raise Refused(fault)
    return limits


def _restart_fault(message: msg.RestartPolicy) -> str:
    allowed = get_args(values.RestartCondition)
    if message.when not in allowed:
        return f"restart {message.when!r}; allowed: {', '.join(allowed)}"
    if not 1.0 <= message.factor <= _MOST_GROWTH:
        return f"the factor of its restarts is {message.factor}; allowed: 1 to {_MOST_GROWTH:g}"
    for name in ("delay", "max_delay", "window"):
        if not 0.0 <= getattr(message, name) <= LONGEST:
            return f"restart.{name} is {getattr(message, name)} s; allowed: 0 to {LONGEST:g}"
    return ""


def _json_value(text: str, what: str) -> Any:
    try:
        return json.loads(text)
    except (ValueError, RecursionError) as error:
        raise Refused(f"{what} is no JSON: {error}") from error


def assignment_to_msg(assignment: values.Assignment) -> msg.Assignment:
    """Return an order to run an instance as a message."""
    fence = assignment.fence or values.Fence(0.0, 0.0)
    return made(
        msg.Assignment,
        instance=instance_to_msg(assignment.instance), epoch=assignment.epoch,
        node_name=assignment.node_name, shadow=assignment.shadow,
        fence_after=float(fence.after), fence_grace=float(fence.grace),
        fence_alive=fence.alive,
        snapshot_hosts=list(assignment.snapshot_hosts), snapshots_from=assignment.snapshots_from,
        restored=assignment.restored, state_key=array("B", assignment.state_key),
        spec=spec_to_msg(assignment.spec),
        devices=[_to_msg(msg.HeldDevice, one) for one in assignment.devices],
        inactive=assignment.inactive,
    )  # fmt: skip


def assignment_from_msg(message: msg.Assignment) -> values.Assignment:
    """Return the inverse of `assignment_to_msg`; raises `Refused`."""
    for name in ("fence_after", "fence_grace"):  # a lease and a delay, each at most this long
        if not 0.0 <= getattr(message, name) <= 2.0 * LONGEST:
            raise Refused(f"{message.instance.process}: {name} is {getattr(message, name)}")
    if len(message.state_key) not in (0, KEY_BYTES):
        raise Refused(
            f"{message.instance.process}: state_key has {len(message.state_key)} bytes; allowed: 0 "
            f"or {KEY_BYTES}"
        )
    fence = None
    if message.fence_after:
        fence = values.Fence(message.fence_after, message.fence_grace, message.fence_alive)
    return values.Assignment(
        instance_from_msg(message.instance), spec_from_msg(message.spec), message.epoch,
        message.node_name, message.shadow, fence, tuple(message.snapshot_hosts),
        message.snapshots_from, message.restored, bytes(message.state_key), _held(message),
        message.inactive,
    )  # fmt: skip


# --- hosts and statuses -----------------------------------------------------------------------


def host_to_msg(host: values.HostDescription) -> msg.HostDescription:
    """Return a host's description as a message."""
    resources = [
        _to_msg(msg.ResourceDescription, resource, slot=slot)
        for slot, resource in enumerate(host.resources)
    ]
    absent, unenforced = (
        {name: sendable(reason) for name, reason in reasons.items()}
        for reasons in (host.absent, host.unenforced)
    )
    host = replace(host, absent=absent, unenforced=unenforced)
    return _to_msg(msg.HostDescription, host, resources=resources)


def host_from_msg(message: msg.HostDescription) -> values.HostDescription:
    """Return the inverse of `host_to_msg`; raises `Refused` for an invalid host."""
    resources = sorted(message.resources, key=lambda resource: int(resource.slot))
    if [resource.slot for resource in resources] != list(range(len(resources))):
        raise Refused(f"host {message.name!r:.250}: its resources do not fill the slots 0, 1, 2, …")
    described = _description(message, resources)
    absent, unenforced = (
        {name: sanitized(reason) for name, reason in reasons.items()}
        for reasons in (described.absent, described.unenforced)
    )
    description = replace(described, absent=absent, unenforced=unenforced)
    fault = description_fault(description)
    if fault:
        raise Refused(fault)
    return description


def _description(
    message: msg.HostDescription, resources: Iterable[msg.ResourceDescription]
) -> values.HostDescription:
    described = tuple(_from_msg(values.ResourceDescription, resource) for resource in resources)
    return _from_msg(values.HostDescription, message, resources=described)


def devices_to_msg(devices: Iterable[Device]) -> list[msg.Device]:
    """Return the devices of a host as messages."""
    return [_to_msg(msg.Device, one) for one in devices]


def devices_from_msg(message: Iterable[msg.Device]) -> tuple[Device, ...]:
    """Return the inverse of `devices_to_msg`; raises `Refused` for invalid devices."""
    devices = tuple(_from_msg(Device, one) for one in message)
    fault = device_fault(devices)
    if fault:
        raise Refused(fault)
    return devices


def status_to_msg(status: values.InstanceStatus) -> msg.ProcessStatus:
    """Return an instance's status as a message."""
    return _to_msg(msg.ProcessStatus, status, message=sendable(status.message)[:MOST_LETTERS])


def status_from_msg(message: msg.ProcessStatus) -> values.InstanceStatus:
    """Return the inverse of `status_to_msg`; raises `Refused` for an invalid status."""
    process = message.instance.process
    if message.state not in _STATES:
        raise Refused(f"unknown state {message.state!r:.100} of {process!r:.250}")
    fault = name_fault(process, "process")
    if fault:
        raise Refused(fault)
    for name, most in _MOST_REPORTED.items():
        if not 0.0 <= getattr(message, name) <= most:
            raise Refused(f"{process}: {name} is {getattr(message, name)}; at most {most:g}")
    lines = message.message.split("\n")
    return _from_msg(
        values.InstanceStatus, message, message="\n".join(sanitized(line) for line in lines),
        devices=_held(message),
    )  # fmt: skip


def snapshot_to_msg(snapshot: values.SnapshotReport) -> msg.SnapshotReport:
    """Return the description of a snapshot on a host as a message."""
    return msg.SnapshotReport(
        process=snapshot.instance.process, number=snapshot.instance.number,
        sequence=snapshot.sequence, size=snapshot.size,
    )  # fmt: skip


def snapshot_from_msg(message: msg.SnapshotReport) -> values.SnapshotReport:
    """Return the inverse of `snapshot_to_msg`; raises `Refused` for an invalid name."""
    fault = name_fault(message.process, "process")
    if fault:
        raise Refused(fault)
    instance = values.InstanceId(message.process, message.number)
    return values.SnapshotReport(instance, message.sequence, message.size)


# --- rows -------------------------------------------------------------------------------------


def host_row_to_msg(row: HostRow) -> msg.HostState:
    """Return a row of `rosrm hosts` as a message."""
    return msg.HostState(
        description=host_to_msg(row.description), host_id=row.host_id, state=row.state,
        cordoned=row.cordoned, draining=row.draining, accepting=row.accepting,
        reading_age=row.reading_age, usage=[r.usage for r in row.resources],
        in_flight=[r.in_flight for r in row.resources], limit=[r.limit for r in row.resources],
        stale=[r.stale for r in row.resources], processes=row.processes, drained=row.drained,
        devices=[_to_msg(msg.DeviceRow, one) for one in row.devices],
    )  # fmt: skip


def _fraction(value: float) -> float:
    """Return a number that travelled as float32, without digits beyond float32's precision."""
    return round(float(value), 6)


def host_row_from_msg(message: msg.HostState) -> HostRow:
    """Return the inverse of `host_row_to_msg`; raises `Refused` for an invalid row."""
    columns = (message.usage, message.in_flight, message.limit, message.stale)
    if {len(message.description.resources)} != {*map(len, columns)}:
        raise Refused(f"host {message.description.name!r}: its readings do not fit its resources")
    resources = tuple(
        ResourceRow(
            resource.name, resource.unit, resource.capacity, resource.scope, _fraction(usage),
            _fraction(in_flight), _fraction(limit), bool(stale),
        )
        for resource, usage, in_flight, limit, stale in zip(
            message.description.resources, *columns, strict=True
        )
    )  # fmt: skip
    description = _description(message.description, message.description.resources)
    return _from_msg(HostRow, message, description=description, resources=resources)


def process_row_to_msg(row: ProcessRow) -> msg.ProcessState:
    """Return a row of `rosrm ps` as a message."""
    known = row.exit_code is not None
    return _to_msg(
        msg.ProcessState, row, exit_code=row.exit_code or 0, exit_code_known=known,
        reason=row.reason[:MOST_LETTERS],
    )  # fmt: skip


def process_row_from_msg(message: msg.ProcessState) -> ProcessRow:
    """Return the inverse of `process_row_to_msg`."""
    exit_code = message.exit_code if message.exit_code_known else None
    return _from_msg(
        ProcessRow, message, cpu=_fraction(message.cpu), cpu_limit=_fraction(message.cpu_limit),
        exit_code=exit_code,
    )  # fmt: skip


def plugin_row_to_msg(row: PluginRow) -> msg.PluginState:
    """Return a row of `rosrm plugins` as a message."""
    return _to_msg(msg.PluginState, row, reason=row.reason[:MOST_LETTERS])


def plugin_row_from_msg(message: msg.PluginState) -> PluginRow:
    """Return the inverse of `plugin_row_to_msg`."""
    return _from_msg(PluginRow, message)


def event_to_msg(row: EventRow) -> msg.Event:
    """Return a line of the event record as a message."""
    return _to_msg(
        msg.Event, row, data=json.dumps(dict(row.facts)), message=row.message[:MOST_LETTERS]
    )


def event_from_msg(message: msg.Event) -> EventRow:
    """Return the inverse of `event_to_msg`."""
    return _from_msg(EventRow, message, facts=json_object(message.data, "an event"))
