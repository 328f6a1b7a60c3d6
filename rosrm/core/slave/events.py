"""Events of the slave, in the past tense."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from rosrm.core.slave.watches import Memo, Observation, Transition
from rosrm.model.values import (
    Amendment,
    Assignment,
    Component,
    InstanceId,
    InstanceStatus,
    LifecycleGoal,
    Run,
)


@dataclass(frozen=True, slots=True)
class Registered:
    """The master registered this host.

    Attributes:
        renumbers: the master has lost its journal, and may use instance numbers again.
    """

    epoch: int
    renumbers: bool = False


@dataclass(frozen=True, slots=True)
class MasterLost:
    """The contact with the master is lost, so it may not receive reports of later ends."""


@dataclass(frozen=True, slots=True)
class AssignmentsReceived:
    """The master assigned instances to this host.

    Attributes:
        given_at: earliest time of the assignment, by the slave's clock; None: just now.
    """

    assignments: tuple[Assignment, ...]
    given_at: float | None = None


@dataclass(frozen=True, slots=True)
class LaunchRefused:
    """An instance cannot be started here."""

    instance: InstanceId
    reason: str


@dataclass(frozen=True, slots=True)
class StartDelayed:
    """The start of an instance waits for something that is being fetched."""

    instance: InstanceId
    reason: str


@dataclass(frozen=True, slots=True)
class StopOrdered:
    """The master ordered to stop an instance for good."""

    instance: InstanceId


@dataclass(frozen=True, slots=True)
class FenceOrdered:
    """The master ordered to kill an instance, because it has a successor."""

    instance: InstanceId


@dataclass(frozen=True, slots=True)
class ContactConfirmed:
    """The master reported that it receives messages from this host.

    Attributes:
        at: send time of the master's message by the slave's clock, not its time of arrival.
    """

    at: float


@dataclass(frozen=True, slots=True)
class RestartOrdered:
    """The master ordered to restart an instance on this host.

    Attributes:
        run: the run that is to end; None: any run.
    """

    instance: InstanceId
    run: Run | None = None


@dataclass(frozen=True, slots=True)
class AmendmentOrdered:
    """The master ordered to change an instance, which is no shadow from then on."""

    instance: InstanceId
    amendment: Amendment


@dataclass(frozen=True, slots=True)
class AmendmentRecorded:
    """The supervisor has recorded an amendment of an instance, or has refused it.

    Attributes:
        refusal: why nothing has changed; "": it has.
    """

    instance: InstanceId
    amendment: Amendment
    refusal: str = ""


@dataclass(frozen=True, slots=True)
class ReportRequested:
    """The master requested the status of every instance."""


@dataclass(frozen=True, slots=True)
class SupervisorReported:
    """The supervisor reported statuses of instances."""

    statuses: tuple[InstanceStatus, ...]


@dataclass(frozen=True, slots=True)
class SupervisorReplaced:
    """Another supervisor took over, or this slave found one at its start.

    Attributes:
        statuses: statuses of all its instances.
        memos: facts about instances that earlier runs of this slave stored there.
        fenced: instances with a fence.
        holds_starts: the new supervisor can hold a start until a slot is free.
    """

    statuses: tuple[InstanceStatus, ...]
    memos: Mapping[InstanceId, Memo] = field(default_factory=dict)
    fenced: frozenset[InstanceId] = frozenset()
    holds_starts: bool = False


@dataclass(frozen=True, slots=True)
class SeenInGraph:
    """The node of this instance, not of another one of the same name, is in the ROS graph."""

    instance: InstanceId


@dataclass(frozen=True, slots=True)
class LifecycleOrdered:
    """The master ordered to bring a lifecycle node to a state, now and after each restart."""

    instance: InstanceId
    goal: LifecycleGoal


@dataclass(frozen=True, slots=True)
class LifecycleStateRead:
    """A node reported its lifecycle state.

    Attributes:
        pid: pid of the run that was asked.
        asked_at: time of the request.
    """

    instance: InstanceId
    pid: int
    state: str
    asked_at: float


@dataclass(frozen=True, slots=True)
class TransitionAnswered:
    """A node answered a request for a lifecycle transition.

    Attributes:
        pid: pid of the run that was asked.
    """

    instance: InstanceId
    pid: int
    transition: Transition
    succeeded: bool


@dataclass(frozen=True, slots=True)
class ComponentsListed:
    """A container listed its components.

    Attributes:
        pid: pid of the run that was asked.
        names: names of their nodes, with the namespaces.
    """

    instance: InstanceId
    pid: int
    names: frozenset[str]


@dataclass(frozen=True, slots=True)
class ComponentLoaded:
    """A container has loaded a component, or cannot.

    Attributes:
        pid: pid of the run.
        fault: why it is not loaded; "": it is.
    """

    instance: InstanceId
    pid: int
    component: Component
    fault: str = ""


@dataclass(frozen=True, slots=True)
class LookedAt:
    """A watched instance was observed.

    Attributes:
        pid: pid of the observed run.
    """

    instance: InstanceId
    pid: int
    look: Observation


@dataclass(frozen=True, slots=True)
class DevicesMissed:
    """Devices of this host are missing.

    Attributes:
        missing: kind and unit of each missing device to the reason.
    """

    missing: Mapping[tuple[str, str], str]


@dataclass(frozen=True, slots=True)
class TimePassed:
    """Time passed without another event; deadlines are checked."""


@dataclass(frozen=True, slots=True)
class Slept:
    """This machine was suspended for some seconds, in which no process could run."""

    seconds: float


Event = (
    Registered
    | MasterLost
    | AssignmentsReceived
    | LaunchRefused
    | StartDelayed
    | StopOrdered
    | FenceOrdered
    | ContactConfirmed
    | RestartOrdered
    | AmendmentOrdered
    | AmendmentRecorded
    | ReportRequested
    | SupervisorReported
    | SupervisorReplaced
    | SeenInGraph
    | LifecycleOrdered
    | LifecycleStateRead
    | TransitionAnswered
    | ComponentsListed
    | ComponentLoaded
    | LookedAt
    | DevicesMissed
    | TimePassed
    | Slept
)
