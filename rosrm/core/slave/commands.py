"""Commands of the slave's core to its runtime, in the imperative."""

from __future__ import annotations

from dataclasses import dataclass

from rosrm.core.slave.watches import ManagedLifecycle, Memo, Transition
from rosrm.model.orders import NOT_AMENDED, NOT_REACHED
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
class Launch:
    """Order the supervisor to start instances.

    Attributes:
        slots: start them once fewer than this number of other instances are active, that is,
            neither held nor ended; 0: start them at once.
    """

    assignments: tuple[Assignment, ...]
    slots: int = 0


@dataclass(frozen=True, slots=True)
class Stop:
    """Order the supervisor to stop an instance."""

    instance: InstanceId


@dataclass(frozen=True, slots=True)
class Fence:
    """Order the supervisor to kill an instance."""

    instance: InstanceId


@dataclass(frozen=True, slots=True)
class Renew:
    """Send the supervisor the time of the last contact, and the time at which this slave runs.

    Attributes:
        at: newest time at which the master received a message of this host.
        alive: time at which this slave runs.

    Both by the boot clock.
    """

    at: float
    alive: float


@dataclass(frozen=True, slots=True)
class Restart:
    """Order the supervisor to restart an instance.

    Attributes:
        run: the run that is to end; None: any run.
    """

    instance: InstanceId
    run: Run | None = None


@dataclass(frozen=True, slots=True)
class Fail:
    """Order the supervisor to end a run as failed, and to apply the restart policy.

    Attributes:
        pid: pid of the run.
        kill: send SIGKILL at once, because a signal has stopped the process.
    """

    instance: InstanceId
    pid: int
    reason: str
    kill: bool


@dataclass(frozen=True, slots=True)
class Amend:
    """Order the supervisor to change an instance; `AmendmentRecorded` follows."""

    instance: InstanceId
    amendment: Amendment


@dataclass(frozen=True, slots=True)
class Settle:
    """Answer the order to change an instance.

    Attributes:
        refusal: why nothing has changed, for example because the instance has ended; "": it has.
        code: of the refusal.
    """

    instance: InstanceId
    amendment: Amendment
    refusal: str = ""
    code: str = NOT_AMENDED


@dataclass(frozen=True, slots=True)
class ReadLifecycleState:
    """Request the lifecycle state of a node; `LifecycleStateRead` follows if it answers.

    Attributes:
        pid: pid of the run.
        at: time of the request.
    """

    instance: InstanceId
    pid: int
    lifecycle: ManagedLifecycle
    at: float


@dataclass(frozen=True, slots=True)
class ChangeLifecycleState:
    """Request a lifecycle transition of a node; `TransitionAnswered` follows if it answers.

    Attributes:
        pid: pid of the run.
        transition: "configure", "activate" or "deactivate".
    """

    instance: InstanceId
    pid: int
    lifecycle: ManagedLifecycle
    transition: Transition


@dataclass(frozen=True, slots=True)
class SettleLifecycle:
    """Answer the order to bring a lifecycle node to a state; `refusal`: why that failed; "": done.

    One command answers all repetitions of the order.
    """

    instance: InstanceId
    goal: LifecycleGoal
    refusal: str = ""
    code: str = NOT_REACHED


@dataclass(frozen=True, slots=True)
class ListComponents:
    """Request the list of a container's components; `ComponentsListed` follows if it answers.

    Attributes:
        pid: pid of the run.
    """

    instance: InstanceId
    pid: int
    services: str


@dataclass(frozen=True, slots=True)
class LoadComponent:
    """Order a container to load a component; `ComponentLoaded` follows.

    Attributes:
        pid: pid of the run.
    """

    instance: InstanceId
    pid: int
    services: str
    component: Component


@dataclass(frozen=True, slots=True)
class Remember:
    """Order the supervisor to store facts for a later run of this slave."""

    instance: InstanceId
    memo: Memo


@dataclass(frozen=True, slots=True)
class Forget:
    """Order the supervisor to forget ended instances."""

    instances: tuple[InstanceId, ...]


@dataclass(frozen=True, slots=True)
class Report:
    """Report statuses to the master; `complete`: all instances are in the report."""

    statuses: tuple[InstanceStatus, ...]
    complete: bool = False


#: Commands that the supervisor executes, once it has the instance.
SupervisorCommand = Stop | Fence | Renew | Restart | Fail | Amend | Remember | Forget
Command = (
    Launch | SupervisorCommand | Settle | ReadLifecycleState | ChangeLifecycleState
    | SettleLifecycle | ListComponents | LoadComponent | Report
)  # fmt: skip
