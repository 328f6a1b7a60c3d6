"""What may happen to a slave, and what its core may ask for."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from rosrm.model.values import Assignment, Health, InstanceId, InstanceStatus, RestartPolicy


@dataclass(frozen=True, slots=True)
class Awaited:
    """How an instance becomes ready by being seen in the ROS graph.

    Attributes:
        node_name: fully qualified name of its node.
        timeout: seconds that each of its runs has for it.
        seen: pid of the run that was seen; 0: none was.
    """

    node_name: str
    timeout: float
    seen: int = 0


@dataclass(frozen=True, slots=True)
class Watch:
    """What is watched of the health of an instance that is ready.

    Attributes:
        wanted: by its spec.
        topics: absolute names of what it must publish, one of them; (): nothing.
        services: absolute names under which its lifecycle state is asked; (): it is not.
        restarts: its slave starts it again, unless a move is under way.
        paused: it is not watched for now: it is a shadow, or is being moved and may be silent.
    """

    wanted: Health
    topics: tuple[str, ...] = ()
    services: tuple[str, ...] = ()
    restarts: bool = True
    paused: bool = False


@dataclass(frozen=True, slots=True)
class Look:
    """What was seen of an instance since the look before.

    Attributes:
        stopped: its session leader is, by a signal.
        heard: messages on its topic; None: it cannot be listened to.
        trouble: why it cannot; "": it can.
        state: of its lifecycle; "": it does not answer; None: that is not known yet.
    """

    stopped: bool = False
    heard: int | None = None
    trouble: str = ""
    state: str | None = None


@dataclass(frozen=True, slots=True)
class Memo:
    """What a later run of this slave must know of an instance; its spec it does not know.

    Attributes:
        awaited: None: it is ready as soon as it runs.
        watch: None: its health is not watched.
    """

    awaited: Awaited | None = None
    watch: Watch | None = None


# --- what can happen --------------------------------------------------------------------------


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
    """No master is heard, or another one: what ends now it may not have been told."""


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
        memos: what it was told to remember of instances.
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


# --- what is asked for ------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Launch:
    """Have the supervisor start instances."""

    assignments: tuple[Assignment, ...]


@dataclass(frozen=True, slots=True)
class Stop:
    """Have the supervisor stop an instance."""

    instance: InstanceId


@dataclass(frozen=True, slots=True)
class Fence:
    """Have the supervisor end an instance at once."""

    instance: InstanceId


@dataclass(frozen=True, slots=True)
class Renew:
    """Tell the supervisor when the master last heard this host, and that this slave is at work.

    Attributes:
        at, alive: by the monotonic clock.
    """

    at: float
    alive: float


@dataclass(frozen=True, slots=True)
class Restart:
    """Have the supervisor restart an instance."""

    instance: InstanceId


@dataclass(frozen=True, slots=True)
class Fail:
    """Have the supervisor end a run as failed, and go on by its restart policy.

    Attributes:
        pid: of the run.
        kill: it is stopped, and cannot end in good order.
    """

    instance: InstanceId
    pid: int
    reason: str
    kill: bool


@dataclass(frozen=True, slots=True)
class Amend:
    """Have the supervisor keep another restart policy; `RestartPolicyRecorded` follows."""

    instance: InstanceId
    restart: RestartPolicy


@dataclass(frozen=True, slots=True)
class Settle:
    """Answer the order to set this restart policy; `refusal`: why it cannot be; "": it is."""

    instance: InstanceId
    restart: RestartPolicy
    refusal: str = ""


@dataclass(frozen=True, slots=True)
class Remember:
    """Have the supervisor keep this for a later run of this slave."""

    instance: InstanceId
    memo: Memo


@dataclass(frozen=True, slots=True)
class Forget:
    """Let the supervisor forget ended instances."""

    instances: tuple[InstanceId, ...]


@dataclass(frozen=True, slots=True)
class Report:
    """Tell the master; `complete`: these are all."""

    statuses: tuple[InstanceStatus, ...]
    complete: bool = False


Command = (
    Launch | Stop | Fence | Renew | Restart | Fail | Amend | Settle | Remember | Forget | Report
)

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
