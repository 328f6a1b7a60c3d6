"""Orders of the master to a slave, one class each."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Final

from rosrm.model.links import MEASURE_SECONDS, LinkPeer
from rosrm.model.values import EMPTY, Amendment, Assignment, InstanceId, LifecycleGoal, Run


@dataclass(frozen=True, slots=True)
class StartInstance:
    """Start an assigned instance."""

    assignment: Assignment

    @property
    def instance(self) -> InstanceId:
        """Return the instance of the assignment."""
        return self.assignment.instance


@dataclass(frozen=True, slots=True)
class StopInstance:
    """Stop an instance for good."""

    instance: InstanceId


@dataclass(frozen=True, slots=True)
class FenceInstance:
    """Kill an instance at once, because it has a successor."""

    instance: InstanceId


@dataclass(frozen=True, slots=True)
class RestartInstance:
    """Stop an instance and start it again on the same host.

    Attributes:
        run: the run that is to end: a late copy of the order changes no later one; None: any run.
    """

    instance: InstanceId
    run: Run | None = None


#: Codes with which a slave refuses an `AmendInstance` or `SetLifecycleState` that it cannot carry
#: out.
NOT_AMENDED: Final = "not_amended"
NOT_REACHED: Final = "unable"
#: The same for an instance that has ended (a report follows), and for an unknown one.
ENDED: Final = "ended"
UNKNOWN: Final = "unknown"
#: Code of the refusal of an order that is not for this run of the slave: nothing was done, and the
#: master gives the order again if it is still needed.
STALE: Final = "stale"


@dataclass(frozen=True, slots=True)
class AmendInstance:
    """Change an instance that runs on, and is no shadow from then on."""

    instance: InstanceId
    amendment: Amendment


@dataclass(frozen=True, slots=True)
class SetLifecycleState:
    """Bring the lifecycle node of an instance to a state, now and after each restart."""

    instance: InstanceId
    state: LifecycleGoal


@dataclass(frozen=True, slots=True)
class ReportInstances:
    """Report the status of every instance."""


@dataclass(frozen=True, slots=True)
class ReloadSettings:
    """Read the settings of the host from its file again; the answer says what has changed."""


@dataclass(frozen=True, slots=True)
class RunExecutor:
    """Run an executor of a plugin.

    Attributes:
        timeout: seconds.
    """

    executor: str
    arguments: Mapping[str, Any] = field(default_factory=lambda: EMPTY)
    timeout: float = 0.0


@dataclass(frozen=True, slots=True)
class ReplicateSnapshot:
    """Replicate the snapshots of an instance to these hosts from now on.

    Attributes:
        hosts: names of the hosts; (): no replication.
        every: shortest time between two transfers, in seconds.
    """

    instance: InstanceId
    hosts: tuple[str, ...]
    every: float


@dataclass(frozen=True, slots=True)
class DropReplica:
    """Delete the snapshots of a process that were written by instances up to this one."""

    instance: InstanceId


@dataclass(frozen=True, slots=True)
class MeasureLinks:
    """Measure the links to other hosts; the answer has a `LinkReport`.

    Attributes:
        peers: the other hosts; (): report addresses, interfaces and flows only.
        learn: measure the flows to the instances of this host from now on.
    """

    peers: tuple[LinkPeer, ...] = ()
    learn: bool = False


#: Orders to the slave's core.
InstanceOrder = (
    StartInstance
    | StopInstance
    | FenceInstance
    | RestartInstance
    | AmendInstance
    | SetLifecycleState
    | ReportInstances
)
Order = (
    InstanceOrder | RunExecutor | ReplicateSnapshot | DropReplica | ReloadSettings | MeasureLinks
)

#: Seconds that the check of a settings file may take.
CHECK_TIMEOUT: Final = 20.0


def seconds_of(order: Order) -> float:
    """Return the seconds for which a slave may execute an order before it answers."""
    if isinstance(order, MeasureLinks):
        return MEASURE_SECONDS
    if isinstance(order, ReloadSettings):
        return CHECK_TIMEOUT
    return order.timeout if isinstance(order, RunExecutor) else 0.0
