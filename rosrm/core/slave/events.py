"""Events of the slave, in the past tense."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from rosrm.core.slave.watches import Memo, Observation
from rosrm.model.values import Assignment, InstanceId, InstanceStatus, RestartPolicy


@dataclass(frozen=True, slots=True)
class Registered:
    """The master registered this host.

    Attributes:
        renumbers: the master has lost its journal, and may use instance numbers a second time.
    """

    epoch: int
    renumbers: bool = False


@dataclass(frozen=True, slots=True)
class MasterLost:
    """The contact with the master is lost: later ends may not reach it."""


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
class StopOrdered:
    """The master ordered an instance to end for good."""

    instance: InstanceId


@dataclass(frozen=True, slots=True)
class FenceOrdered:
    """The master ordered an instance to end at once, because it has a successor."""

    instance: InstanceId


@dataclass(frozen=True, slots=True)
class ContactConfirmed:
    """The master reported that it receives messages from this host.

    Attributes:
        at: time at which the master sent this, by the slave's clock; not the time of arrival.
    """

    at: float


@dataclass(frozen=True, slots=True)
class RestartOrdered:
    """The master ordered an instance to restart on this host."""

    instance: InstanceId


@dataclass(frozen=True, slots=True)
class RestartPolicySet:
    """The master set another restart policy for an instance; it is no shadow any more."""

    instance: InstanceId
    restart: RestartPolicy


@dataclass(frozen=True, slots=True)
class RestartPolicyRecorded:
    """The supervisor has recorded the restart policy of an instance."""

    instance: InstanceId
    restart: RestartPolicy


@dataclass(frozen=True, slots=True)
class ReportRequested:
    """The master asked for the status of every instance."""


@dataclass(frozen=True, slots=True)
class SupervisorReported:
    """The supervisor reported statuses of instances."""

    statuses: tuple[InstanceStatus, ...]


@dataclass(frozen=True, slots=True)
class SupervisorReplaced:
    """Another supervisor took over, or this slave found one at its start.

    Attributes:
        statuses: all that it holds.
        memos: facts about instances that earlier runs of this slave stored there.
        fenced: the instances that have a fence.
    """

    statuses: tuple[InstanceStatus, ...]
    memos: Mapping[InstanceId, Memo] = field(default_factory=dict)
    fenced: frozenset[InstanceId] = frozenset()


@dataclass(frozen=True, slots=True)
class SeenInGraph:
    """This instance, not another one of the same name, is in the ROS graph."""

    instance: InstanceId


@dataclass(frozen=True, slots=True)
class LookedAt:
    """A watched instance was observed.

    Attributes:
        pid: of the observed run.
    """

    instance: InstanceId
    pid: int
    look: Observation


@dataclass(frozen=True, slots=True)
class TimePassed:
    """Time passed without another event; deadlines are checked."""


Event = (
    Registered
    | MasterLost
    | AssignmentsReceived
    | LaunchRefused
    | StopOrdered
    | FenceOrdered
    | ContactConfirmed
    | RestartOrdered
    | RestartPolicySet
    | RestartPolicyRecorded
    | ReportRequested
    | SupervisorReported
    | SupervisorReplaced
    | SeenInGraph
    | LookedAt
    | TimePassed
)
