"""Rules on a process entry of a work file, beyond the forms of its values."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from collections.abc import Set as AbstractSet
from dataclasses import dataclass
from typing import Final

from rosrm.model.arrays import INDEX_PLACEHOLDER
from rosrm.model.artifacts import artifacts_fault
from rosrm.model.component_rules import components_fault
from rosrm.model.container_rules import container_fault
from rosrm.model.description_checks import (
    is_namespace,
    is_node_name,
    name_fault,
    node_name_fault,
    other_process_fault,
)
from rosrm.model.devices import need_fault
from rosrm.model.job_checks import job_fault
from rosrm.model.lifecycle_rules import lifecycle_fault
from rosrm.model.limits import limits_fault
from rosrm.model.parameters import parameter_fault
from rosrm.model.placeholders import (
    ARTIFACTS,
    DEVICE,
    WITH_PLACEHOLDERS,
    has_variable,
    placeholder_faults,
    variable_fault,
)
from rosrm.model.secret_rules import is_variable, secret_faults
from rosrm.model.stop_rules import stop_fault
from rosrm.model.values import Kind, ProcessSpec, StartOrder
from rosrm.wording import listed

_TOPIC: Final = re.compile(r"(~?/)?[A-Za-z_][A-Za-z0-9_]*(/[A-Za-z_][A-Za-z0-9_]*)*")
#: A name in a rule of ROS, which may have the name of a node and wildcards.
_REMAPPED: Final = re.compile(r"[^\s:=\0]+(:[^\s:=\0]+)*")
#: Bytes of a variable, with its name, from which on the kernel starts no program with it.
_LONGEST_TEXT: Final = 1 << 17
_LIFECYCLE: Final = ("unconfigured", "inactive", "active", "finalized")
_ROS_ONLY: Final = ("node_name", "namespace", "parameters", "remappings")


@dataclass(frozen=True, slots=True)
class Complaint:
    """Violation of a rule: path of the wrong value in the entry, and a description."""

    path: tuple[str, ...]
    text: str


def complaints(spec: ProcessSpec, wrong: AbstractSet[str]) -> Iterator[Complaint]:
    """Yield every violation of a rule by the spec of an entry.

    Args:
        spec: unreadable values have their defaults.
        wrong: keys whose values could not be read; rules that read them are skipped.
    """
    for rule, keys in _RULES:
        if wrong.isdisjoint(keys):
            yield from rule(spec)


def _about_ros(spec: ProcessSpec) -> Iterator[Complaint]:
    yield from _about_node(spec) if spec.ros else _about_others(spec)


def _about_restarts(spec: ProcessSpec) -> Iterator[Complaint]:
    if spec.restart.max_delay < spec.restart.delay:
        text = "restart.max_delay must not be less than restart.delay"
        yield Complaint(("restart", "max_delay"), text)


def _about_ends(spec: ProcessSpec) -> Iterator[Complaint]:
    if spec.time_limit and spec.kind != "job":
        yield Complaint(("time_limit",), "time_limit: only a job has one; a service runs on")
    if spec.reschedule.delay and not spec.reschedule.attempts:
        text = "reschedule.delay requires `attempts`, the number of other hosts to try"
        yield Complaint(("reschedule", "delay"), text)


def _about_jobs(spec: ProcessSpec) -> Iterator[Complaint]:
    fault = job_fault(spec)
    if fault:
        yield Complaint((fault.partition(":")[0],), fault)
    texts = ("command", "arguments", "parameters", "remappings", "environment")
    for key in texts if not spec.array.name else ():
        found = INDEX_PLACEHOLDER.search(repr(getattr(spec, key)))
        if found:
            text = f"{key}: {found[0]} needs `array` in the process, such as `array: 1-100`"
            yield Complaint((key,), text)


def about_retries(spec: ProcessSpec, keys: AbstractSet[str]) -> Iterator[Complaint]:
    """Yield the violations of the rules on `retries`, which is a short form of `restart`.

    `keys`: those of the entry.
    """
    if "retries" in keys and "restart" in keys:
        text = (
            "retries is a short form of `restart: {when: on-failure, attempts: N}`; give only one"
        )
        yield Complaint(("retries",), text)
    if "retries" in keys and spec.kind is not Kind.JOB:
        text = "retries: only a job has it, and this process is a service; it has `restart`"
        yield Complaint(("retries",), text)


def about_empty(keys: AbstractSet[str]) -> Iterator[Complaint]:
    """Yield a complaint on each empty mapping that would ask for nothing without saying so."""
    for key in keys & _EMPTY.keys():
        yield Complaint((key,), f"{key}: {{}} {_EMPTY[key]}")


def _about_faults(spec: ProcessSpec) -> Iterator[Complaint]:
    standby = spec.standby
    if standby.wanted and spec.kind == "job":
        yield Complaint(("standby",), "a job runs to completion; only a service has a standby")
    if standby.apart_by and not standby.wanted:
        yield Complaint(("standby", "apart_by"), "standby.apart_by requires `wanted: true`")
    if spec.isolation.after and spec.isolation.then == "keep":
        yield Complaint(("isolation", "after"), "isolation.after requires `then: stop`")
    if spec.host_loss.delay and spec.host_loss.then == "wait":
        text = "host_loss.delay requires `then: elsewhere` or `then: stop`"
        yield Complaint(("host_loss", "delay"), text)


def _about_neighbours(spec: ProcessSpec) -> Iterator[Complaint]:
    for rule in spec.neighbours:
        key = rule.relation
        if not rule.processes and not rule.group:
            yield Complaint((key,), f"{key}: at least one process is required")
        for name in rule.processes:
            fault = other_process_fault(name, spec.name)
            if fault:
                yield Complaint((key,), f"{key}: {fault}")


def _about_start_order(spec: ProcessSpec) -> Iterator[Complaint]:
    order = spec.start_order
    for name in order.after:
        fault = other_process_fault(name, spec.name)
        if fault:
            yield Complaint(("after", name), f"after: {fault}")
    if order != StartOrder() and not order.after:
        text = "after: the name of at least one process is required"
        yield Complaint(("after",), text)


def _about_devices(spec: ProcessSpec) -> Iterator[Complaint]:
    for need in spec.devices:
        fault = need_fault((need,))
        if fault:
            yield Complaint(("devices", need.kind), f"devices: {fault}")


def _about_artifacts(spec: ProcessSpec) -> Iterator[Complaint]:
    fault = artifacts_fault(spec.artifacts)
    if fault:
        yield Complaint(("artifacts",), f"artifacts: {fault}")
    for one in spec.artifacts:
        if not one.source:
            yield Complaint(("artifacts", one.name), f"artifacts.{one.name}: a path is required")


def _about_placeholders(spec: ProcessSpec) -> Iterator[Complaint]:
    known = [f"{DEVICE}{need.kind}" for need in spec.devices]
    known += [ARTIFACTS] if spec.artifacts else []
    for key in WITH_PLACEHOLDERS:
        if key != "environment" and has_variable(repr(getattr(spec, key))):
            text = f"{key}: {{env.NAME}} is allowed only in `environment`"
            yield Complaint((key,), text)
        for fault in placeholder_faults(repr(getattr(spec, key)), known):
            given = "parameters" if key == "parameter_sources" else key
            yield Complaint((given,), f"{given}: {fault}")


def _about_flows(spec: ProcessSpec) -> Iterator[Complaint]:
    for name in spec.talks_to:
        fault = other_process_fault(name, spec.name)
        if fault:
            yield Complaint(("talks_to", name), f"talks_to: {fault}")


def _about_gang(spec: ProcessSpec) -> Iterator[Complaint]:
    fault = name_fault(spec.together, "gang") if spec.together else ""
    if fault:
        yield Complaint(("together",), f"together: {fault}")


def _about_limits(spec: ProcessSpec) -> Iterator[Complaint]:
    fault = limits_fault(spec) or stop_fault(spec)
    if fault:
        yield Complaint((fault.partition(".")[0].partition(":")[0],), fault)


def _about_health(spec: ProcessSpec) -> Iterator[Complaint]:
    health = spec.health
    if bool(health.topic) != bool(health.rate):
        text = "health.topic and health.rate (Hz, above 0) must be given together"
        yield Complaint(("health",), text)
    if health.topic and not _TOPIC.fullmatch(health.topic):
        text = f"health.topic {health.topic!r} is no ROS topic; for example /scan, scan or ~/scan"
        yield Complaint(("health", "topic"), text)
    if health.lifecycle and health.lifecycle not in _LIFECYCLE:
        text = f"health.lifecycle {health.lifecycle!r}; allowed: {', '.join(_LIFECYCLE)}"
        yield Complaint(("health", "lifecycle"), text)
    if (health.topic or health.lifecycle) and not spec.ros:
        text = "health: only a ROS node has topics and a lifecycle; set `ros: true` if this is one"
        yield Complaint(("health",), text)
    if (health.topic.startswith("~") or health.lifecycle) and spec.ros and not spec.node:
        text = "health: the name of the node is required, and `node_name: keep` leaves it unknown"
        yield Complaint(("health",), text)


def _about_lifecycle(spec: ProcessSpec) -> Iterator[Complaint]:
    fault = lifecycle_fault(spec)
    if fault:
        yield Complaint(("lifecycle",), fault)


def _about_components(spec: ProcessSpec) -> Iterator[Complaint]:
    fault = components_fault(spec)
    if fault:
        yield Complaint(("components",), fault)


def _about_program(spec: ProcessSpec) -> Iterator[Complaint]:
    programs = {
        "package + executable": spec.package or spec.executable,
        "module": spec.module,
        "command": spec.command,
    }
    given = [name for name, value in programs.items() if value]
    if len(given) != 1:
        fault = f"{listed(given)} are given" if given else "no program is given"
        yield Complaint((), f"{fault}; give one of package + executable, module or command")
    elif spec.package and not spec.executable:
        text = f"package {spec.package!r} is given without an executable"
        yield Complaint(("package",), text)
    elif spec.executable and not spec.package:
        text = f"executable {spec.executable!r} is given without a package"
        advice = "a program that is in no ROS package goes under `command`"
        yield Complaint(("executable",), f"{text}; {advice}")


def _about_others(spec: ProcessSpec) -> Iterator[Complaint]:
    for name in _ROS_ONLY:
        if getattr(spec, name) or (name == "parameters" and spec.parameter_sources):
            text = f"{name}: only a ROS node has one; set `ros: true` if this is one"
            yield Complaint((name,), text)
    if spec.readiness.kind == "graph":
        text = "readiness: only a ROS node is seen in the graph"
        yield Complaint(("readiness", "kind"), text)


def _about_node(spec: ProcessSpec) -> Iterator[Complaint]:
    if spec.node and not is_node_name(spec.node):
        text = node_name_fault(spec.node)
        if spec.array.name:
            text += f"; write {{array.index}} into the name: {spec.array.name}_{{array.index}}"
        elif not spec.node_name:
            text += "; to give the node another name than the process, set `node_name`"
        yield Complaint(("node_name" if spec.node_name else "name",), text)
    if spec.namespace and not is_namespace(spec.namespace):
        text = f"{spec.namespace!r} is not an absolute namespace such as '/robot1'"
        yield Complaint(("namespace",), text)
    for name, value in spec.parameters.items():
        fault = parameter_fault(name, value)
        if fault:
            yield Complaint(("parameters", *name.split(".")), f"parameters.{name}: {fault}")
    for source in spec.parameter_sources:
        for name, value in source.parameters.items():
            fault = parameter_fault(name, value)
            if fault:
                yield Complaint(("parameters",), f"parameters: {source.nodes} {name}: {fault}")


def _about_remappings(spec: ProcessSpec) -> Iterator[Complaint]:
    for rule in spec.remappings.items():
        for name in rule:
            if not _REMAPPED.fullmatch(name):
                text = f"remappings: {name!r} is no name in ROS, such as /scan, image or ~/state"
                yield Complaint(("remappings", rule[0]), text)


def _about_surroundings(spec: ProcessSpec) -> Iterator[Complaint]:
    directory = spec.working_directory
    if directory == "":
        text = 'working_directory: "" is no directory; leave it out for one of the process\'s own'
        yield Complaint(("working_directory",), text)
    for name, value in spec.environment.items():
        if not is_variable(name, value):
            yield Complaint(("environment", name), f"environment: {name!r} cannot be a variable")
        elif len(f"{name}={value}".encode(errors="replace")) >= _LONGEST_TEXT:
            size = f"at most {_LONGEST_TEXT >> 10} KiB are allowed; pass a long text in a file"
            yield Complaint(("environment", name), f"environment.{name}: too long: {size}")
        elif fault := variable_fault(value):
            yield Complaint(("environment", name), f"environment.{name}: {fault}")
        elif spec.container.image and has_variable(value):
            text = f"environment.{name}: {{env.NAME}} cannot name a variable of an image"
            yield Complaint(("environment", name), text)


def _about_secrets(spec: ProcessSpec) -> Iterator[Complaint]:
    for name, fault in secret_faults(spec):
        yield Complaint(("secrets", name), fault)


def _about_container(spec: ProcessSpec) -> Iterator[Complaint]:
    fault = container_fault(spec)
    if fault:
        yield Complaint(("container",), fault)


#: Sections that ask for nothing if they are empty, and what they lack.
_EMPTY: Final = {
    "health": "has no condition, such as `health: {topic: scan, rate: 10}`",
    "reschedule": "allows no other host, such as `reschedule: {attempts: 2}`",
    "spread": (
        "spreads the processes of one entry with `foreach` or `array`, and this is a single "
        "process. Give the processes of several entries one group: `spread: {group: maps}`"
    ),
}  # fmt: skip
_Rule = Callable[[ProcessSpec], Iterator[Complaint]]
_PROGRAM: Final = ("package", "executable", "module", "command")
#: Each rule with the keys that it reads.
_RULES: Final[tuple[tuple[_Rule, tuple[str, ...]], ...]] = (
    (_about_program, _PROGRAM),
    (_about_ros, ("name", "ros", *_PROGRAM, *_ROS_ONLY, "readiness")),
    (_about_remappings, ("remappings",)),
    (_about_surroundings, ("working_directory", "environment", "container")),
    (_about_secrets, ("secrets", "environment")),
    (_about_container, ("container",)),
    (_about_restarts, ("restart",)),
    (_about_ends, ("time_limit", "kind", "reschedule")),
    (_about_jobs, ("array", "parallel", "every", "at", "on", "kind")),
    (_about_faults, ("standby", "migration", "kind", "isolation", "host_loss")),
    (_about_health, ("health", "ros", "node_name", *_PROGRAM)),
    (_about_lifecycle, ("lifecycle", "ros", "node_name", "readiness", *_PROGRAM)),
    (_about_components, ("components", "ros", "node_name", "readiness", "lifecycle", *_PROGRAM)),
    (_about_neighbours, ("name", "near", "apart", "spread")),
    (_about_start_order, ("name", "after")),
    (_about_devices, ("devices",)),
    (_about_artifacts, ("artifacts",)),
    (_about_placeholders, ("devices", "artifacts", *WITH_PLACEHOLDERS)),
    (_about_flows, ("name", "talks_to")),
    (_about_gang, ("together",)),
    (_about_limits, ("limits", "cpus", "realtime", "needs")),
)
