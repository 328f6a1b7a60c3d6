"""State of the slave's core, and rules that depend on readings or a spec alone."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from math import inf
from typing import Final

from rosrm.core.newest import Newest
from rosrm.core.slave.health import InstanceHealth
from rosrm.core.slave.watches import (
    Awaited,
    LoadedComponents,
    ManagedLifecycle,
    Memo,
    Transition,
    Watch,
)
from rosrm.model.artifacts import Artifact
from rosrm.model.devices import HeldDevice
from rosrm.model.values import (
    Amendment,
    Assignment,
    Component,
    InstanceId,
    InstanceState,
    InstanceStatus,
    LifecycleGoal,
    ProcessSpec,
)

#: Ended and refused instances of which a late order to start is refused: those of some seconds, at
#: the highest rate of jobs.
_MOST_TOMBSTONES: Final = 2_000


@dataclass(slots=True)
class Steering:
    """Way of a lifecycle node to its goal.

    Attributes:
        began: time at which the node got its goal, or appeared in the graph.
        deadline: time by which the state must be known, or the transition must be complete.
        read_at: time of the newest request for the state.
        state: newest known state; "": unknown.
        transition: transition under way; None: none.
    """

    began: float
    deadline: float
    read_at: float
    state: str = ""
    transition: Transition | None = None


@dataclass(slots=True)
class Loading:
    """Work on the components of a container.

    Attributes:
        asked_at: time of the newest request for the list of its components.
        answered: components that it has loaded, as it says.
        current: component that it is loading; None: none.
    """

    asked_at: float
    answered: tuple[Component, ...] = ()
    current: Component | None = None


@dataclass(slots=True)
class HeldInstance:
    """One instance on this host.

    Attributes:
        status: newest reported status.
        spec: None: the instance already ran when this slave started.
        awaited: None: the instance is ready as soon as it runs.
        ready_by: time by which it must be ready; None: it is ready, or does not run.
        watch: health checks; None: no checks.
        judgement: health of the watched run; None: not watched, or not observed yet.
        fenced: it has a fence.
        unready: why it was stopped, if it did not become ready in time; "": it did.
        unsettled: amendments that the master has ordered and the supervisor has not recorded yet,
            in order.
        ended_at: time of its end, or of the report of the end to a newly registered master.
        began: start of its first run; None: it has not started.
        amended: changes since the assignment, which a start must have; None: none.
        devices: devices that it holds.
        artifacts: artifacts that it uses.
        lifecycle: None: the slave does not change the lifecycle state of its node.
        loads: None: the slave loads no components into it.
        loading: None: it is not in the graph, or has all its components.
        steering: None: its node is not in the graph, or has reached its goal.
        ordered: goal of an order of the master that is not answered yet; None: there is none.
    """

    status: InstanceStatus
    spec: ProcessSpec | None = None
    awaited: Awaited | None = None
    ready_by: float | None = None
    watch: Watch | None = None
    judgement: InstanceHealth | None = None
    fenced: bool = False
    unready: str = ""
    unsettled: tuple[Amendment, ...] = ()
    ended_at: float = 0.0
    began: float | None = None
    amended: Amendment | None = None
    devices: tuple[HeldDevice, ...] = ()
    artifacts: tuple[Artifact, ...] = ()
    lifecycle: ManagedLifecycle | None = None
    loads: LoadedComponents | None = None
    loading: Loading | None = None
    steering: Steering | None = None
    ordered: LifecycleGoal | None = None

    @property
    def memo(self) -> Memo:
        """Return the facts that a later run of this slave needs."""
        return Memo(
            self.awaited, self.watch, self.devices, self.artifacts, self.lifecycle, self.loads
        )

    @property
    def becomes_ready(self) -> bool:
        """Return True if it runs and is not ready yet."""
        ready = self.status.state is InstanceState.READY
        return self.ready_by is not None or (self.steering is not None and not ready)

    @property
    def watched(self) -> Watch | None:
        """Return the health checks that apply now; None: none."""
        ready = self.status.state is InstanceState.READY
        return self.watch if ready and self.watch is not None and not self.watch.paused else None


@dataclass(slots=True)
class SlaveState:
    """The state of the slave's core.

    Attributes:
        now: time of the newest event.
        max_processes: highest number of running processes; 0: no bound.
        max_starting: highest number of processes that are starting and not ready; 0: no bound.
        max_age: age in seconds from which an assignment is not accepted.
        registered: a master has registered this host.
        report_unconfirmed: a report was made while this host was not registered, perhaps after the
            registration was sent.
        last_contact: newest known time at which the master received a message of this host; 0:
            unknown.
        renewed_at: time of the last `Renew` to the supervisor.
        held: all instances, including ended ones that may still be reported.
        alive: those of `held` that have not ended. Many ended ones would slow down each start.
        nodes: those of `alive` with a node in the ROS graph, because the loop of the slave checks
            them in each turn, and most jobs have no node.
        waiting: assignments that start as soon as the bounds allow, in order.
        unreported: held instance to the time at which its wait will be reported.
        holds_starts: the supervisor can hold a start until a slot is free.
        tombstones: ended and refused instances, which never start on this host again.
    """

    now: float = 0.0
    max_processes: int = 0
    max_starting: int = 0
    max_age: float = inf
    epoch: int = 0
    registered: bool = False
    report_unconfirmed: bool = False
    last_contact: float = 0.0
    renewed_at: float = 0.0
    held: dict[InstanceId, HeldInstance] = field(default_factory=dict)
    alive: dict[InstanceId, HeldInstance] = field(default_factory=dict)
    nodes: dict[InstanceId, HeldInstance] = field(default_factory=dict)
    waiting: dict[InstanceId, Assignment] = field(default_factory=dict)
    unreported: dict[InstanceId, float] = field(default_factory=dict)
    holds_starts: bool = False
    tombstones: Newest[InstanceId, None] = field(default_factory=lambda: Newest(_MOST_TOMBSTONES))

    def hold(self, instance: InstanceId, held: HeldInstance) -> HeldInstance:
        """Add an instance, or note that its status is another one."""
        self.held[instance] = held
        if held.status.state.ended:
            self._drop_alive(instance)
            return held
        self.alive[instance] = held
        if held.awaited is not None:
            self.nodes[instance] = held
        return held

    def drop(self, instance: InstanceId) -> HeldInstance:
        """Forget an instance, and return it."""
        self._drop_alive(instance)
        return self.held.pop(instance)

    def _drop_alive(self, instance: InstanceId) -> None:
        self.alive.pop(instance, None)
        self.nodes.pop(instance, None)

    def used_artifacts(self) -> list[tuple[Artifact, ...]]:
        """Return the artifacts of each instance that has not ended."""
        return [held.artifacts for held in self.alive.values() if held.artifacts]

    def awaited_in_graph(self) -> Mapping[InstanceId, HeldInstance]:
        """Return the instances that become ready when their node appears in the ROS graph."""
        return {one: held for one, held in self.nodes.items() if held.ready_by is not None}

    def ready_nodes(self) -> Mapping[int, str]:
        """Return the number of each ready instance with a node to the node's full name."""
        return {
            instance.number: held.awaited.node_name
            for instance, held in self.nodes.items()
            if held.awaited is not None and held.status.state is InstanceState.READY
        }

    def watched(self) -> Mapping[InstanceId, HeldInstance]:
        """Return the instances with health checks that apply now."""
        return {one: held for one, held in self.alive.items() if held.watched is not None}

    def statuses(self) -> tuple[InstanceStatus, ...]:
        """Return the status of every instance, including ended ones that may still be reported."""
        return self.reported(held.status for held in self.held.values())

    def reported(self, statuses: Iterable[InstanceStatus]) -> tuple[InstanceStatus, ...]:
        """Return the statuses with the devices that the instances hold, and their time so far."""
        return tuple(self._reported(status) for status in statuses)

    def _reported(self, status: InstanceStatus) -> InstanceStatus:
        held = self.held.get(status.instance)
        if held is None:
            return status
        if held.devices:
            status = replace(status, devices=held.devices)
        if status.pid and held.began is not None and not status.state.ended:
            status = replace(status, run_time=max(0.0, self.now - held.began))
        return status

    def slots(self) -> int:
        """Return the number of further instances that `max_processes` allows to run."""
        waiting = len(self.waiting)
        return self.max_processes - (self.live() - waiting) if self.max_processes else waiting

    def startable(self) -> int:
        """Return the number of waiting instances that may start now."""
        most = min(len(self.waiting), self.slots())
        if most > 0 and self.max_starting:
            most = min(most, self.max_starting - self.starting())
        return max(0, most)

    def why_wait(self) -> str:
        """Return the reason why instances wait; call this when none of them may start."""
        if self.slots() <= 0:
            return f"waits for a free slot (max_processes: {self.max_processes})"
        return f"waits until others there have started (max_starting: {self.max_starting})"

    def starting(self) -> int:
        """Return the number of instances being started, or running and not ready yet."""
        return sum(
            held.status.state is InstanceState.STARTING or held.becomes_ready
            for held in self.alive.values()
        )

    def live(self) -> int:
        """Return the number of instances that have not ended."""
        return len(self.alive)


def under_limits(usage: Sequence[float], limit: Sequence[float], present: int, stale: int) -> bool:
    """Return True if a host may request work: each limited reading is fresh and under its limit.

    Args:
        usage, limit: fractions by slot; limit 1: no limit.
        present, stale: bit i is slot i.
    """
    return all(
        most >= 1.0 or not present >> slot & 1 or (used < most and not stale >> slot & 1)
        for slot, used, most in zip(range(present.bit_length()), usage, limit, strict=False)
    )
