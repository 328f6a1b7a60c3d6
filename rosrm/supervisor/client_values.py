"""Values of the core in the slave's messages to and from its supervisor."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from rosrm.core.supervisor.rules import (
    AdoptionRule,
    FenceRule,
    LimitRule,
    RestartRule,
    RunLimits,
    StopRule,
)
from rosrm.model.values import (
    EMPTY,
    Amendment,
    Enforcement,
    Fence,
    InstanceId,
    InstanceState,
    InstanceStatus,
    Limits,
    ProcessSpec,
    RestartPolicy,
    StopPolicy,
)
from rosrm.supervisor import messages


@dataclass(frozen=True, slots=True)
class LaunchOrder:
    """A start order.

    Attributes:
        argv: the command line; its first word is looked up in the PATH of `environment`.
        environment: the whole environment; nothing is inherited.
        working_directory: None: the default one, below the state directory.
        memo: kept by the supervisor for a later run of the client; see `SupervisorClient.memos`.
        fence: rule by which the supervisor ends the instance without an order; None: never.
        limits: limits and scheduling.
        last_contact: of the master with this host, by the boot clock; 0.0: now.
        secrets: variable to the path of a file, which the supervisor reads at each start.
        adoption: the process that becomes the first run; None: the first run is started.
        slots: start once fewer than this number of other instances are active, that is, neither
            held nor ended; 0: start at once.
        files: words of `argv` that should name files in the working directory.
        contents: path to the content of a file that the instance reads. The supervisor records the
            content, and writes the file before each start.
    """

    instance: InstanceId
    argv: tuple[str, ...]
    environment: Mapping[str, str]
    working_directory: str | None = None
    restart: RestartPolicy = field(default_factory=RestartPolicy)
    stop: StopPolicy = field(default_factory=StopPolicy)
    memo: str = ""
    fence: Fence | None = None
    last_contact: float = 0.0
    limits: LimitRule = field(default_factory=LimitRule)
    secrets: Mapping[str, str] = field(default_factory=lambda: EMPTY)
    adoption: AdoptionRule | None = None
    slots: int = 0
    files: tuple[str, ...] = ()
    contents: Mapping[str, str] = field(default_factory=lambda: EMPTY, repr=False)


@dataclass(frozen=True, slots=True)
class Amended:
    """The supervisor has recorded an amendment of an instance, or has refused it.

    Attributes:
        refusal: why nothing has changed; "": it has.
    """

    instance: InstanceId
    amendment: Amendment
    refusal: str = ""


#: Messages of the supervisor about an instance.
SupervisorMessage = InstanceStatus | Amended


def key_of(instance: InstanceId) -> tuple[str, int]:
    """Return the supervisor's key of an instance."""
    return (instance.process, instance.number)


def fence_rule(fence: Fence | None) -> FenceRule | None:
    """Return a fence as the supervisor's rule."""
    return None if fence is None else FenceRule(fence.after, fence.grace, fence.alive)


def restart_rule(restart: RestartPolicy) -> RestartRule:
    """Return a restart policy as the supervisor's rule."""
    return RestartRule(*(getattr(restart, name) for name in RestartRule._fields))


def stop_rule(stop: StopPolicy) -> StopRule:
    """Return a stop policy as the supervisor's rule."""
    return StopRule(*(getattr(stop, name) for name in StopRule._fields))


def limit_rule(spec: ProcessSpec) -> LimitRule:
    """Return the limits and the scheduling of a process as the supervisor's rule."""
    limits, realtime = spec.limits, spec.realtime
    return LimitRule(
        limits.memory, limits.memory_high, limits.cpu, spec.cpus, realtime.policy,
        realtime.priority, spec.nice, limits.enforce == "required",
    )  # fmt: skip


def run_limits(limits: Limits | None) -> RunLimits | None:
    """Return limits as the supervisor's change of a running instance; None: none."""
    if limits is None:
        return None
    required = limits.enforce == "required"
    return RunLimits(limits.memory, limits.memory_high, limits.cpu, required)


def amendment_from(fields: Mapping[str, Any]) -> Amendment:
    """Return an amendment from the supervisor's message about it."""
    restart = RestartPolicy(*messages.read_restart(fields["restart"]))
    changed = messages.read_run_limits(fields.get("limits"))
    if changed is None:
        return Amendment(restart)
    enforce: Enforcement = "required" if changed.required else "preferred"
    return Amendment(restart, Limits(changed.memory, changed.memory_high, changed.cpu, enforce))


def status_from(value: object) -> InstanceStatus:
    """Return an instance's status from its JSON list."""
    assert isinstance(value, list)
    status = messages.read_status(value)
    return InstanceStatus(InstanceId(*status.instance), InstanceState(status.state), *status[2:])
