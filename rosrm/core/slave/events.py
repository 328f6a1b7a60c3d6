"""Events of the slave, in the past tense."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from rosrm.core.slave.watches import Look, Memo
from rosrm.model.values import Assignment, InstanceId, InstanceStatus, RestartPolicy


@dataclass(frozen=True, slots=True)
class Registered:
    """The master took this host in.

    Attributes:
        renumbers: it has lost its journal, and gives numbers again that were given before.
    """

    epoch: int
    renumbers: bool = False


@dataclass(frozen=True, slots=True)
class MasterLost:
    """The contact with the master is lost: it may not learn of an end that follows."""


@dataclass(frozen=True, slots=True)
class AssignmentsReceived:
    """The master assigned instances to this host.

    Attributes:
        given_at: when it did so at the earliest, by the slave's clock; None: just now.
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
    """The master wants an instance to end for good."""

    instance: InstanceId


@dataclass(frozen=True, slots=True)
class FenceOrdered:
    """The master wants an instance to be gone at once: it has a successor."""

    instance: InstanceId


@dataclass(frozen=True, slots=True)
class MasterHears:
    """The master that this host is registered with had heard it when it said so.

    Attributes:
        at: when that was, by the slave's clock; not when it arrived.
    """

    at: float


@dataclass(frozen=True, slots=True)
class RestartOrdered:
    """The master wants an instance to start again here."""

    instance: InstanceId


@dataclass(frozen=True, slots=True)
class RestartPolicySet:
    """The master wants an instance to have another restart policy; a shadow is none any more."""

    instance: InstanceId
    restart: RestartPolicy


@dataclass(frozen=True, slots=True)
class RestartPolicyRecorded:
    """The supervisor has written down which restart policy an instance has."""

    instance: InstanceId
    restart: RestartPolicy


@dataclass(frozen=True, slots=True)
class ReportRequested:
    """The master wants to know of every instance."""


@dataclass(frozen=True, slots=True)
class SupervisorReported:
    """The supervisor says what became of instances."""

    statuses: tuple[InstanceStatus, ...]


@dataclass(frozen=True, slots=True)
class SupervisorReplaced:
    """Another supervisor took over, or this slave found one at its start.

    Attributes:
        statuses: all that it knows.
        memos: what earlier runs of this slave had it remember of instances.
        fenced: which of them have a fence.
    """

    statuses: tuple[InstanceStatus, ...]
    memos: Mapping[InstanceId, Memo] = field(default_factory=dict)
    fenced: frozenset[InstanceId] = frozenset()


@dataclass(frozen=True, slots=True)
class SeenInGraph:
    """This very instance, not a namesake, is in the ROS graph."""

    instance: InstanceId


@dataclass(frozen=True, slots=True)
class LookedAt:
    """One that is watched was looked at.

    Attributes:
        pid: of the run that was.
    """

    instance: InstanceId
    pid: int
    look: Look


@dataclass(frozen=True, slots=True)
class TimePassed:
    """Nothing else happened; deadlines are looked at."""


Event = (
    Registered
    | MasterLost
    | AssignmentsReceived
    | LaunchRefused
    | StopOrdered
    | FenceOrdered
    | MasterHears
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
