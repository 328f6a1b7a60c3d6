"""What a slave says to its supervisor and hears of it, in the core's values."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from rosrm.core.supervisor.reducer import FenceRule, RestartRule, StopRule
from rosrm.model.values import (
    Fence,
    InstanceId,
    InstanceState,
    InstanceStatus,
    RestartPolicy,
    StopPolicy,
)
from rosrm.supervisor import messages


@dataclass(frozen=True, slots=True)
class LaunchOrder:
    """What is to be started.

    Attributes:
        argv: the command line; its first word is looked up in the PATH of `environment`.
        environment: the whole of it, nothing is inherited.
        working_directory: None: one of its own, below the state directory.
        memo: kept by the supervisor for a later run of the client; see `SupervisorClient.memos`.
        fence: when the supervisor ends it by itself; None: never.
        heard: when the master last heard this host, monotonic; 0.0: just now.
    """

    instance: InstanceId
    argv: tuple[str, ...]
    environment: Mapping[str, str]
    working_directory: str | None = None
    restart: RestartPolicy = field(default_factory=RestartPolicy)
    stop: StopPolicy = field(default_factory=StopPolicy)
    memo: str = ""
    fence: Fence | None = None
    heard: float = 0.0


@dataclass(frozen=True, slots=True)
class Amended:
    """The supervisor has recorded that an instance has this restart policy from now on."""

    instance: InstanceId
    restart: RestartPolicy


#: What the supervisor tells of an instance.
Told = InstanceStatus | Amended


def key_of(instance: InstanceId) -> tuple[str, int]:
    """As the supervisor names it."""
    return (instance.process, instance.number)


def fence_rule(fence: Fence | None) -> FenceRule | None:
    """As the supervisor has it."""
    return None if fence is None else FenceRule(fence.after, fence.grace, fence.alive)


def restart_rule(restart: RestartPolicy) -> RestartRule:
    """As the supervisor has it."""
    return RestartRule(*(getattr(restart, name) for name in RestartRule._fields))


def stop_rule(stop: StopPolicy) -> StopRule:
    """As the supervisor has it."""
    return StopRule(*(getattr(stop, name) for name in StopRule._fields))


def status_from(value: object) -> InstanceStatus:
    """What the supervisor says of an instance."""
    assert isinstance(value, list)
    status = messages.read_status(value)
    return InstanceStatus(InstanceId(*status.instance), InstanceState(status.state), *status[2:])
