"""Base of simulated hosts: a slave's core, and programs in place of real processes.

The hosts of the simulator and those of the unit tests share it. Here nothing takes time; the
subclasses add the usage of the programs, delays and faults.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from array import array
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Generic, NamedTuple, TypeVar

import numpy as np
import numpy.typing as npt

from rosrm.core.master.commands import OrderId, SendOrder
from rosrm.core.master.events import OrderAnswered, StatusesReceived, UsagesReceived
from rosrm.core.master.state.host_arrays import FloatArray
from rosrm.core.slave import commands, events, reducer
from rosrm.core.slave.lifecycle_nodes import STATE_AFTER
from rosrm.core.slave.orders import event_of, why_stale
from rosrm.core.slave.state import SlaveState, under_limits
from rosrm.errors import assert_never
from rosrm.model.devices import Device
from rosrm.model.orders import (
    STALE,
    AmendInstance,
    DropReplica,
    MeasureLinks,
    ReloadSettings,
    ReplicateSnapshot,
    RunExecutor,
    SetLifecycleState,
)
from rosrm.model.values import (
    EMPTY,
    MOST_USED,
    RESOURCE_SLOTS,
    Amendment,
    Assignment,
    HostDescription,
    InstanceId,
    InstanceState,
    InstanceStatus,
    Limits,
    ResourceDescription,
    RestartPolicy,
)

_SIGINT, _SIGKILL = 2, 9


@dataclass(slots=True, kw_only=True)
class Program:
    """One instance on a host.

    Attributes:
        restart: restart policy that the supervisor applies when the instance ends.
        limits: as last changed while it runs.
        run: number of its starts after the first one; a delayed action for an earlier run has no
            effect.
        restarts: number of those that its restart policy caused.
        lifecycle_state: state of its node, if that is a lifecycle node.
    """

    assignment: Assignment
    restart: RestartPolicy
    pid: int
    limits: Limits = field(default_factory=Limits)
    state: InstanceState = InstanceState.STARTING
    run: int = 0
    restarts: int = 0
    lifecycle_state: str = "unconfigured"


ProgramT = TypeVar("ProgramT", bound=Program)


class SimulatedReading(NamedTuple):
    """A slave's reading.

    Attributes:
        at: time of the reading.
        usage: (RESOURCE_SLOTS,) fractions.
        stale: bit i stands for slot i.
        accepts: the host is under all its limits and takes work.
    """

    at: float
    usage: FloatArray
    stale: int
    accepts: bool


@dataclass(kw_only=True)
class Host(ABC, Generic[ProgramT]):
    """Simulated host: its slave and its programs.

    Attributes:
        limits: upper limits, fractions by resource.
        busy: usage by other programs, fractions by resource.
        uses: bytes of memory below which no program's limit can be set while it runs.
        devices: devices of the host.
        start_time, stop_time: seconds that a program takes to start and to stop.
        incarnation: of its slave.
        host_id: assigned by the master; 0: not registered.
        programs: instances that really run; they outlive the slave.
        ends: statuses of ended instances that the supervisor remembers.
        polled: assignments at the master that wait for the slave's next request.
        status_batches: status batches on their way to the master.
        stale: resources whose readings are too old.
        measured: resources that are not attributed, whose usage by each program is measured.
        limit: (RESOURCE_SLOTS,) as in its readings.
        newest_pid: of its programs; each start of a program has another one.
    """

    name: str = field(kw_only=False)
    resources: tuple[ResourceDescription, ...] = ()
    limits: Mapping[str, float] = field(default_factory=lambda: EMPTY)
    labels: Mapping[str, str] = field(default_factory=lambda: EMPTY)
    max_processes: int = 0
    busy: Mapping[str, float] = field(default_factory=lambda: EMPTY)
    uses: float = 0.0
    period: float = 0.1
    start_time: float = 0.0
    stop_time: float = 0.0
    incarnation: int = 0
    devices: tuple[Device, ...] = ()

    host_id: int = 0
    slave: SlaveState = field(default_factory=SlaveState)
    programs: dict[InstanceId, ProgramT] = field(default_factory=dict)
    ends: dict[InstanceId, InstanceStatus] = field(default_factory=dict)
    polled: list[Assignment] = field(default_factory=list)
    status_batches: deque[StatusesReceived] = field(default_factory=deque)
    stale: set[str] = field(default_factory=set)
    measured: frozenset[str] = frozenset()
    sequence: int = 0
    batches: int = 0
    newest_pid: int = 100
    limit: FloatArray = field(init=False)
    _settled: list[commands.Settle | commands.SettleLifecycle] = field(default_factory=list)

    def __post_init__(self) -> None:
        """Prepare the slave's core and the limits."""
        self.slave.max_processes = self.max_processes
        self.limit = np.ones(RESOURCE_SLOTS)
        limits = [self.limits.get(one.name, 1.0) for one in self.resources]
        self.limit[: len(limits)] = limits

    # --- differences between the simulator's hosts and those of the unit tests -------------

    @abstractmethod
    def make_program(self, assignment: Assignment, restart: RestartPolicy) -> ProgramT:
        """Return the program of a new instance."""

    @abstractmethod
    def used_by(self, program: ProgramT, now: float) -> Mapping[str, float]:
        """Return the base units of each resource that an instance uses."""

    @abstractmethod
    def spent(self, program: ProgramT, now: float) -> tuple[float, float, float]:
        """Return run time, peak memory and CPU time of an instance that ends."""

    def execute(self, order_id: OrderId, order: RunExecutor) -> OrderAnswered:
        """Run an executor, and answer; a simulated host has none."""
        message = f"the simulation cannot carry out {order.executor!r}"
        return OrderAnswered(order_id, False, "failed", message)

    def measure(self, order_id: OrderId, _order: MeasureLinks) -> OrderAnswered:
        """Measure links, and answer; a simulated host does not."""
        return OrderAnswered(order_id, False, "refused", "the simulation does not measure links")

    def replicate(self, order: ReplicateSnapshot | DropReplica) -> None:
        """Carry out an order about snapshots; here nodes publish none."""

    def say(self, batch: StatusesReceived) -> None:
        """Send statuses to the master."""
        self.status_batches.append(batch)

    def later(self, _seconds: float, now: float, action: Callable[[float], None]) -> None:
        """Call an action after some seconds, with the time at which it happens."""
        action(now)

    def run_begins(self, program: ProgramT, now: float) -> None:
        """Note that a program runs from now on."""

    def run_begins_again(self, program: ProgramT, now: float) -> None:
        """Note that a program starts again."""

    def run_ended(self, now: float) -> None:
        """Note that a program is gone."""

    # --- messages to the master ------------------------------------------------------------

    def description(self) -> HostDescription:
        """Return the description with which its slave registers."""
        return HostDescription(
            self.name, self.incarnation, labels=self.labels, resources=self.resources,
            max_processes=self.max_processes, period=self.period, devices=self.devices,
        )  # fmt: skip

    def usage(self, now: float) -> dict[str, float]:
        """Return the fraction of each resource that is used."""
        used = self._amounts(now).values()
        return {
            one.name: self.busy.get(one.name, 0.0)
            + sum(amounts.get(one.name, 0.0) for amounts in used) / one.capacity
            for one in self.resources
        }

    def reading(self, now: float) -> SimulatedReading:
        """Return the slave's reading."""
        used, count = self.usage(now), len(self.resources)
        usage = np.zeros(RESOURCE_SLOTS)
        usage[:count] = [used[one.name] for one in self.resources]
        stale = sum((one.name in self.stale) << slot for slot, one in enumerate(self.resources))
        accepts = under_limits(
            array("f", usage.tolist()), array("f", self.limit.tolist()), (1 << count) - 1, stale
        )
        return SimulatedReading(now, usage, stale, accepts)

    def used(self, now: float) -> tuple[tuple[int, float, float], ...]:
        """Return number, cores and bytes of each instance."""
        return tuple(
            (instance.number, amounts.get("cpu", 0.0), amounts.get("memory", 0.0))
            for instance, amounts in self._amounts(now).items()
        )

    def _amounts(self, now: float) -> dict[InstanceId, Mapping[str, float]]:
        return {one: self.used_by(program, now) for one, program in self.programs.items()}

    def usages(self, now: float) -> UsagesReceived:
        """Return the event with the usage of each instance."""
        used = self._amounts(now)

        def column(resource: str) -> npt.NDArray[np.float64]:
            return np.array([amounts.get(resource, 0.0) for amounts in used.values()], np.float64)

        measured = self.measured | self.description().accounted("attributed") - MOST_USED.keys()
        others = {
            slot: column(resource.name)
            for slot, resource in enumerate(self.resources)
            if resource.name in measured
        }
        return UsagesReceived(
            self.host_id, self.incarnation, np.array([one.number for one in used], np.uint64),
            column("cpu"), column("memory"), others,
        )  # fmt: skip

    # --- the slave -------------------------------------------------------------------------

    def tell(self, event: events.Event, now: float) -> None:
        """Process an event in the slave's core, and carry out its commands."""
        for command in reducer.step(self.slave, event, now):
            self._carry_out(command, now)

    def _carry_out(self, command: commands.Command, now: float) -> None:
        match command:
            case commands.Report(statuses, complete):
                self.batches += 1
                batch = StatusesReceived(
                    self.host_id, self.incarnation, self.batches, complete, statuses
                )
                self.say(replace(batch, devices=self.devices))
            case commands.Launch(assignments):
                for assignment in assignments:
                    self._launch(assignment, now)
            case commands.Settle() | commands.SettleLifecycle():
                self._settled.append(command)
            case commands.ReadLifecycleState() | commands.ChangeLifecycleState():
                self.tell(self._answer_of_node(command), now)
            case commands.ListComponents() | commands.LoadComponent():
                pass  # here no container loads components
            case _:
                self._supervise(command, now)

    def _supervise(self, command: commands.SupervisorCommand, now: float) -> None:
        """Carry out a command of the slave as its supervisor does."""
        match command:
            case commands.Stop(instance):
                self._stop(instance, now)
            case commands.Fence(instance):
                self._fence(instance, now)
            case commands.Restart(instance, run):
                there = self.programs[instance]
                is_meant = run is None or run.is_that_of(there.pid, there.restarts)
                if is_meant and there.state is InstanceState.RUNNING:
                    self._restart(instance, now)
            case commands.Amend(instance, amendment):
                program = self.programs.get(instance)  # None: its start has the amendment
                refusal = "" if program is None else self._amend(program, amendment)
                self.tell(events.AmendmentRecorded(instance, amendment, refusal), now)
            case commands.Forget(instances):
                for instance in instances:
                    self.ends.pop(instance, None)
            case commands.Renew() | commands.Remember() | commands.Fail():
                pass  # here no slave is cut off from its master, restarted or observed
            case _:
                assert_never(command)

    def _answer_of_node(
        self, request: commands.ReadLifecycleState | commands.ChangeLifecycleState
    ) -> events.Event:
        """Return the answer of a lifecycle node, whose transitions succeed."""
        instance, pid = request.instance, request.pid
        program = self.programs[instance]
        if isinstance(request, commands.ReadLifecycleState):
            return events.LifecycleStateRead(instance, pid, program.lifecycle_state, request.at)
        program.lifecycle_state = STATE_AFTER[request.transition]
        return events.TransitionAnswered(instance, pid, request.transition, succeeded=True)

    def obey(self, sent: SendOrder, now: float) -> OrderAnswered:
        """Carry out an order, and return the answer."""
        order, code = sent.order, "refused"
        refusal = why_stale(order, registered=self.slave.registered)
        if refusal:
            return OrderAnswered(sent.order_id, False, STALE, refusal)
        match order:
            case RunExecutor():
                return self.execute(sent.order_id, order)
            case MeasureLinks():
                return self.measure(sent.order_id, order)
            case ReplicateSnapshot() | DropReplica():
                self.replicate(order)
            case ReloadSettings():
                refusal = "a simulated host has no file"
            case AmendInstance():
                self._settled.clear()
                self.tell(event_of(order), now)
                (settled,) = self._settled
                refusal, code = settled.refusal, settled.code
            case SetLifecycleState():
                self._settled.clear()
                self.tell(event_of(order), now)
                refusal = next((one.refusal for one in self._settled), "the node is not ready")
            case _:
                self.tell(event_of(order), now)
        return OrderAnswered(sent.order_id, not refusal, code if refusal else "", refusal)

    def shut_down(self, now: float) -> None:
        """Stop all instances, as a slave does that leaves."""
        for instance, held in list(self.slave.held.items()):
            if not held.status.state.ended:
                self.tell(events.StopOrdered(instance), now)

    # --- programs --------------------------------------------------------------------------

    def _amend(self, program: ProgramT, amendment: Amendment) -> str:
        """Change a program; return why nothing changes, "": it does."""
        limits = amendment.limits or program.limits
        if 0.0 < limits.memory < self.uses:
            return f"it uses {self.uses:g} B already"
        program.restart, program.limits = amendment.restart, limits
        return ""

    def next_pid(self) -> int:
        """Return the pid of a program that starts."""
        self.newest_pid += 1
        return self.newest_pid

    def _supervisor_says(self, status: InstanceStatus, now: float) -> None:
        self.tell(events.SupervisorReported((status,)), now)

    def _launch(self, assignment: Assignment, now: float) -> None:
        silent = assignment.shadow or assignment.restored
        restart = RestartPolicy() if silent else assignment.spec.restart
        instance = assignment.instance
        program = self.programs[instance] = self.make_program(assignment, restart)
        held = self.slave.held.get(instance)
        if held is not None and held.amended is not None:
            self._amend(program, held.amended)
        self.later(self.start_time, now, partial(self._started, instance, 0))

    def _started(self, instance: InstanceId, run: int, now: float) -> None:
        program = self.programs.get(instance)
        if program is None or program.run != run or program.state is not InstanceState.STARTING:
            return
        program.state = InstanceState.RUNNING
        self.run_begins(program, now)
        status = InstanceStatus(
            instance, InstanceState.RUNNING, pid=program.pid, restarts=program.restarts
        )
        self._supervisor_says(status, now)

    def _restart(self, instance: InstanceId, now: float, *, by_policy: bool = False) -> None:
        program = self.programs[instance]
        if program.state is InstanceState.STOPPING:
            return  # an order to stop prevails
        former = InstanceStatus(
            instance, InstanceState.STOPPING, pid=program.pid, restarts=program.restarts
        )
        program.restarts += by_policy
        program.state = InstanceState.STARTING
        # With the former pid, the slave would report a node as ready before it is in the graph.
        program.pid = self.next_pid()
        program.run += 1
        program.lifecycle_state = "unconfigured"
        self.run_begins_again(program, now)
        self._supervisor_says(former, now)
        seconds = self.stop_time + self.start_time
        self.later(seconds, now, partial(self._started, instance, program.run))

    def _stop(self, instance: InstanceId, now: float) -> None:
        program = self.programs.get(instance)
        if program is None or program.state is InstanceState.STOPPING:
            return
        program.state = InstanceState.STOPPING
        status = InstanceStatus(
            instance, InstanceState.STOPPING, pid=program.pid, restarts=program.restarts
        )
        self._supervisor_says(status, now)
        self.later(self.stop_time, now, partial(self._stopped, instance))

    def _fence(self, instance: InstanceId, now: float) -> None:
        if instance in self.programs:
            self._end(instance, InstanceState.FENCED, now, signal=_SIGKILL)

    def _stopped(self, instance: InstanceId, now: float) -> None:
        if instance in self.programs:
            self._end(instance, InstanceState.EXITED, now, signal=_SIGINT)

    def _end(
        self, instance: InstanceId, state: InstanceState, now: float, *, code: int = 0,
        signal: int = 0,
    ) -> None:  # fmt: skip
        run_time, peak_memory, cpu_time = self.spent(self.programs[instance], now)
        restarts = self.programs[instance].restarts
        del self.programs[instance]
        self.run_ended(now)
        status = InstanceStatus(
            instance, state, exit_code=code, exit_signal=signal, run_time=run_time,
            restarts=restarts,
            peak_memory=peak_memory, cpu_time=cpu_time,
            message=f"exit code {code}" if code else "",
        )  # fmt: skip
        self.ends[instance] = status
        self._supervisor_says(status, now)
