"""Readiness and health checks of an instance."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum
from typing import Final, Literal

from rosrm.model.artifacts import Artifact
from rosrm.model.devices import HeldDevice
from rosrm.model.values import Component, Health, LifecycleGoal

#: Lifecycle transitions that a slave requests.
Transition = Literal["configure", "activate", "deactivate"]


#: `Awaited.seen` of an instance whose first run is restored, and as ready as it was when frozen.
FIRST_RUN: Final = -1


class NoState(Enum):
    """Reason why the lifecycle state of a node is not known."""

    NOT_YET = "no request was sent to the node, or its answer may still arrive"
    NO_ANSWER = "the node does not answer"


@dataclass(frozen=True, slots=True)
class Awaited:
    """Readiness of an instance whose node must appear in the ROS graph.

    Attributes:
        node_name: fully qualified name of its node; "": a node of any name.
        timeout: seconds in which the node of each run must appear.
        seen: pid of the run whose node has appeared; 0: none; `FIRST_RUN`: that of the first run.
    """

    node_name: str
    timeout: float
    seen: int = 0


@dataclass(frozen=True, slots=True)
class Watch:
    """Health checks of an instance that is ready.

    Attributes:
        checks: checks that the spec declares.
        topics: absolute names, on one of which the node must publish; (): no check.
        services: absolute names of services that return the lifecycle state; (): no check.
        restarts: the slave restarts the instance, except during a migration.
        paused: the checks are paused, because a shadow or a migrating instance may be silent.
        parameters: absolute names of services that return whether the node uses simulated time; ():
            the checks depend on no clock of the node.
    """

    checks: Health
    topics: tuple[str, ...] = ()
    services: tuple[str, ...] = ()
    restarts: bool = True
    paused: bool = False
    parameters: tuple[str, ...] = field(default=(), compare=False)


@dataclass(frozen=True, slots=True)
class Observation:
    """Observation of an instance since the previous observation.

    Attributes:
        stopped: a signal (SIGSTOP) has stopped its session leader.
        messages: number of messages on its topic; None: the topic cannot be received.
        trouble: why the topic cannot be received; "": it can.
        state: label of its lifecycle state, or the reason why the state is unknown.
        clock: newest time of `/clock`, for a node with `use_sim_time`; None: its rate counts by the
            clock of the machine.
    """

    stopped: bool = False
    messages: int | None = None
    trouble: str = ""
    state: str | NoState = NoState.NOT_YET
    clock: float | None = None


@dataclass(frozen=True, slots=True)
class ManagedLifecycle:
    """State to which the slave brings a lifecycle node after each start and each restart.

    Attributes:
        get_state: absolute name of the service that returns the state.
        change_state: absolute name of the service that changes the state.
        timeout: seconds for each transition.
    """

    goal: LifecycleGoal
    get_state: str
    change_state: str
    timeout: float


@dataclass(frozen=True, slots=True)
class LoadedComponents:
    """Components that the slave loads into a container after each start and each restart.

    Attributes:
        services: absolute name in front of the names of the container's services.
        components: in the order of loading.
    """

    services: str
    components: tuple[Component, ...]


@dataclass(frozen=True, slots=True)
class Memo:
    """Facts about an instance for a later run of this slave, which does not know its spec.

    Attributes:
        awaited: None: the instance is ready as soon as it runs.
        watch: None: the instance has no health checks.
        devices: devices that the instance holds.
        artifacts: artifacts that the instance uses.
        lifecycle: None: the slave does not change the lifecycle state of the node.
        loads: None: the slave loads no components into the instance.
    """

    awaited: Awaited | None = None
    watch: Watch | None = None
    devices: tuple[HeldDevice, ...] = ()
    artifacts: tuple[Artifact, ...] = ()
    lifecycle: ManagedLifecycle | None = None
    loads: LoadedComponents | None = None
