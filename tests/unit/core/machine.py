"""Simulated host for unit tests: its running processes, its slave, and the wires to the master."""

from __future__ import annotations

from collections import defaultdict, deque
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from rosrm.core.master import events as happened
from rosrm.core.master.commands import OrderId, SendOrder
from rosrm.core.slave import events, reducer
from rosrm.core.slave.commands import (
    Amend,
    Command,
    Fence,
    Forget,
    Launch,
    Report,
    Restart,
    Settle,
    Stop,
)
from rosrm.core.slave.orders import event_of
from rosrm.core.slave.state import SlaveState
from rosrm.model.orders import DropReplica, ReplicateSnapshot, RunExecutor, SetRestartPolicy
from rosrm.model.values import (
    EMPTY,
    Assignment,
    HostDescription,
    InstanceId,
    InstanceState,
    InstanceStatus,
    KeptState,
    ResourceDescription,
    RestartPolicy,
)
from tests.unit.core.nodes import Node

MIB = 2.0**20
GIB = 2.0**30


@dataclass
class Program:
    """Instance that really runs.

    Attributes:
        node: present run of the node, if it can be moved with its state.
        restart: restart policy that the supervisor applies when the instance ends.
    """

    assignment: Assignment
    node: Node
    restart: RestartPolicy
    state: InstanceState = InstanceState.RUNNING
    pid: int = 0


@dataclass
class Machine:
    """Simulated host: its running processes, its slave, and the wires from and to the master.

    Attributes:
        programs: instances that really run; outlives the slave.
        ends: statuses of ended instances that the supervisor remembers.
        refuses: process name to the reason why it cannot be started here.
        stubborn: process names that do not end when ordered to stop.
        quirks: of the nodes of a process here, by process name; see `Node`.
        busy: usage of each resource without our processes, fraction.
        shown: base units that each process uses, by name; shows in readings and usages.
        polled: assignments at the master that wait for the slave's next request.
        ordered: orders on their way to the slave.
        said: status batches on their way to the master.
        kept: newest snapshot or replica of each process on this host, by process name.
        ships: hosts that receive replicas of a process on this host, by process name.
        connected: True while the wires work.
    """

    name: str
    memory: float = 16 * GIB
    cpu: float = 8.0
    limits: Mapping[str, float] = field(default_factory=lambda: {"memory": 0.8, "cpu": 0.9})
    labels: Mapping[str, str] = field(default_factory=lambda: EMPTY)
    period: float = 0.1
    max_processes: int = 0
    resources: tuple[ResourceDescription, ...] = ()
    executors: dict[str, Callable[[Mapping[str, Any]], Any]] = field(default_factory=dict)

    host_id: int = 0
    incarnation: int = 0
    slave: SlaveState = field(default_factory=SlaveState)
    programs: dict[InstanceId, Program] = field(default_factory=dict)
    ends: dict[InstanceId, InstanceStatus] = field(default_factory=dict)
    refuses: dict[str, str] = field(default_factory=dict)
    stubborn: set[str] = field(default_factory=set)
    quirks: dict[str, set[str]] = field(default_factory=lambda: defaultdict(set))
    settled: list[Settle] = field(default_factory=list)
    busy: dict[str, float] = field(default_factory=lambda: {"memory": 0.1, "cpu": 0.1})
    shown: dict[str, dict[str, float]] = field(default_factory=lambda: defaultdict(dict))
    polled: list[Assignment] = field(default_factory=list)
    ordered: deque[SendOrder] = field(default_factory=deque)
    said: deque[happened.StatusesReceived] = field(default_factory=deque)
    kept: dict[str, KeptState] = field(default_factory=dict)
    ships: dict[str, tuple[str, ...]] = field(default_factory=dict)
    connected: bool = True
    takes: bool = True
    fresh: bool = False
    stale: set[str] = field(default_factory=set)
    sequence: int = 0
    batches: int = 0
    pids: int = 100

    def __post_init__(self) -> None:
        self.slave.max_processes = self.max_processes
        if not self.resources:
            self.resources = (
                ResourceDescription("memory", "B", self.memory),
                ResourceDescription("cpu", "core", self.cpu),
            )

    # --- messages to the master ----------------------------------------------------------

    def description(self) -> HostDescription:
        return HostDescription(
            self.name, self.incarnation, hostname=f"{self.name}.local", pid=7, labels=self.labels,
            resources=self.resources, max_processes=self.max_processes,
            executors=tuple(self.executors), period=self.period,
        )  # fmt: skip

    def begin_to_register(self) -> None:
        """Start a registration: a new run of the slave drops orders meant for the former run."""
        if self.fresh:
            self.ordered.clear()

    def usage(self) -> dict[str, float]:
        """Return the usage of each resource as a fraction, our running processes included."""
        usage = dict(self.busy)
        for program in self.programs.values():
            for resource in self.resources:
                amount = self.shown[program.assignment.instance.process].get(resource.name, 0.0)
                usage[resource.name] = usage.get(resource.name, 0.0) + amount / resource.capacity
        return usage

    def limit(self, resource: str) -> float:
        return self.limits.get(resource, 1.0)

    def accepts(self) -> bool:
        """Return True if the slave judges the host to be under all its limits."""
        usage = self.usage()
        return self.takes and all(
            usage.get(one.name, 0.0) < self.limit(one.name) for one in self.resources
        )

    def usages(self) -> happened.UsagesReceived:
        """Return the event with the usage of each instance."""
        held = list(self.programs)
        used = [self.shown[one.process] for one in held]
        return happened.UsagesReceived(
            self.host_id, self.incarnation,
            np.array([one.number for one in held], np.uint64),
            np.array([one.get("cpu", 0.0) for one in used]),
            np.array([one.get("memory", 0.0) for one in used]),
        )  # fmt: skip

    def _report(self, commands: Iterable[Command], now: float) -> None:
        for command in commands:
            if isinstance(command, Report):
                self.batches += 1
                self.said.append(
                    happened.StatusesReceived(
                        self.host_id, self.incarnation, self.batches, command.complete,
                        command.statuses,
                    )
                )  # fmt: skip
            else:
                self._carry_out(command, now)

    def _carry_out(self, command: Command, now: float) -> None:
        if isinstance(command, Launch):
            for assignment in command.assignments:
                self._launch(assignment, now)
        elif isinstance(command, Stop):
            self._stop(command.instance, now)
        elif isinstance(command, Fence):
            if command.instance in self.programs:
                self._end(command.instance, InstanceState.FENCED, now, signal=9)
        elif isinstance(command, Restart):
            self._restart(command.instance, now)
        elif isinstance(command, Amend):
            self.programs[command.instance].restart = command.restart
            self.tell(events.RestartPolicyRecorded(command.instance, command.restart), now)
        elif isinstance(command, Settle):
            self.settled.append(command)
        elif isinstance(command, Forget):
            for instance in command.instances:
                self.ends.pop(instance, None)

    def tell(self, event: events.Event, now: float) -> None:
        """Pass an event to the slave's reducer and carry out its commands."""
        self._report(reducer.step(self.slave, event, now), now)

    def _supervisor_says(self, status: InstanceStatus, now: float) -> None:
        self.tell(events.SupervisorReported((status,)), now)

    # --- commands of the slave -----------------------------------------------------------

    def _launch(self, assignment: Assignment, now: float) -> None:
        instance = assignment.instance
        reason = self.refuses.get(instance.process)
        if reason is not None:
            self.tell(events.LaunchRefused(instance, reason), now)
            return
        self.pids += 1
        silent = assignment.shadow or assignment.restored
        node = Node(instance, silent, self.quirks[instance.process])
        restart = RestartPolicy() if silent else assignment.spec.restart
        self.programs[instance] = Program(assignment, node, restart, pid=self.pids)
        status = InstanceStatus(instance, InstanceState.RUNNING, pid=self.pids)
        self._supervisor_says(status, now)

    def _stop(self, instance: InstanceId, now: float) -> None:
        program = self.programs.get(instance)
        if program is None:
            return
        if program.state is not InstanceState.STOPPING:
            program.state = InstanceState.STOPPING
            status = InstanceStatus(instance, InstanceState.STOPPING, pid=program.pid)
            self._supervisor_says(status, now)
        if instance.process not in self.stubborn:
            self._end(instance, InstanceState.EXITED, now, signal=2)

    def _restart(self, instance: InstanceId, now: float) -> None:
        program = self.programs[instance]
        self.pids += 1
        program.pid = self.pids
        program.node = Node(instance, False, self.quirks[instance.process])
        for state, pid in ((InstanceState.STOPPING, 0), (InstanceState.RUNNING, self.pids)):
            self._supervisor_says(InstanceStatus(instance, state, pid=pid, restarts=1), now)

    def _end(
        self, instance: InstanceId, state: InstanceState, now: float, *, code: int = 0,
        signal: int = 0, run_time: float = 10.0,
    ) -> None:  # fmt: skip
        used = self.shown[instance.process]
        del self.programs[instance]
        status = InstanceStatus(
            instance, state, exit_code=code, exit_signal=signal, run_time=run_time,
            peak_memory=used.get("memory", 0.0), cpu_time=run_time * used.get("cpu", 0.0),
            message=f"exit code {code}" if code else "",
        )  # fmt: skip
        self.ends[instance] = status
        self._supervisor_says(status, now)

    def find(self, name: str) -> InstanceId:
        """Return the newest running instance of a process."""
        return max(one for one in self.programs if one.process == name)

    def finish(self, name: str, now: float, *, code: int = 0, run_time: float = 10.0) -> None:
        """End a process with an exit code; its restart policy may start it again."""
        when = self.programs[self.find(name)].restart.when
        if when == "always" or (when == "on-failure" and code):
            self._restart(self.find(name), now)
            return
        state = InstanceState.EXITED if code == 0 else InstanceState.FAILED
        self._end(self.find(name), state, now, code=code, run_time=run_time)

    def let_go(self, name: str, now: float) -> None:
        """End a stubborn process."""
        self.stubborn.discard(name)
        self._end(self.find(name), InstanceState.EXITED, now, signal=9)

    def seen_in_graph(self, name: str, now: float) -> None:
        """Show the node of the newest instance in the ROS graph."""
        self.tell(events.SeenInGraph(self.find(name)), now)

    def obey(self, sent: SendOrder, now: float) -> happened.OrderAnswered:
        """Pass an order to the slave and return the answer."""
        order = sent.order
        match order:
            case RunExecutor():
                return self._execute(sent.order_id, order)
            case SetRestartPolicy():
                return self._set_restart(sent.order_id, order, now)
            case ReplicateSnapshot(instance, hosts):
                self.ships[instance.process] = hosts
            case DropReplica(instance):
                kept = self.kept.get(instance.process)
                if kept is not None and kept.instance.number <= instance.number:
                    del self.kept[instance.process]
            case _:
                self.tell(event_of(order), now)
        return happened.OrderAnswered(sent.order_id, accepted=True)

    def _execute(self, order_id: OrderId, order: RunExecutor) -> happened.OrderAnswered:
        try:
            result = self.executors[order.executor](order.arguments)
        except Exception as error:  # noqa: BLE001 - what a test's executor does
            return happened.OrderAnswered(order_id, False, "failed", str(error))
        if not isinstance(result, Mapping):
            return happened.OrderAnswered(order_id, False, happened.BAD_RESULT, "no object")
        return happened.OrderAnswered(order_id, True, result=result)

    def keep_state(self, instance: InstanceId) -> KeptState:
        """Publish a snapshot that is newer than the one before."""
        before = self.kept.get(instance.process)
        cycles = before.sequence if before is not None and before.instance == instance else 0
        self.kept[instance.process] = KeptState(instance, cycles + 1, 100)
        return self.kept[instance.process]

    def take_state(self, state: KeptState) -> None:
        """Receive a replica from another host; the slave keeps only the newest."""
        own = self.kept.get(state.instance.process)
        age = (state.instance.number, state.sequence)
        if own is None or (own.instance.number, own.sequence) < age:
            self.kept[state.instance.process] = state

    def _set_restart(
        self, order_id: OrderId, order: SetRestartPolicy, now: float
    ) -> happened.OrderAnswered:
        self.settled.clear()
        self.tell(event_of(order), now)
        (settled,) = self.settled
        code = "refused" if settled.refusal else ""
        return happened.OrderAnswered(order_id, not code, code, settled.refusal)

    def fetch(self, now: float) -> None:
        """Answer the slave's open request with the assignments that wait for it."""
        batch, self.polled = self.polled, []
        if batch:
            self.tell(events.AssignmentsReceived(tuple(batch)), now)

    def replace_supervisor(self, now: float) -> None:
        """Kill the supervisor; the next one adopts what runs and remembers what ended."""
        fenced = {one for one, it in self.programs.items() if it.assignment.fence is not None}
        statuses = (*self.ends.values(), *self._running())
        self.tell(events.SupervisorReplaced(statuses, {}, frozenset(fenced)), now)

    def _running(self) -> list[InstanceStatus]:
        return [
            InstanceStatus(instance, program.state, pid=program.pid)
            for instance, program in self.programs.items()
        ]

    def begun(self) -> tuple[InstanceStatus, ...]:
        """Return the statuses of all instances, except of those that wait for their start."""
        waiting = self.slave.waiting
        return tuple(one for one in self.slave.statuses() if one.instance not in waiting)

    def stop_unheard(self, now: float) -> None:
        """Stop the slave while no master hears it; it ends all its processes."""
        for instance in list(self.programs):
            self._end(instance, InstanceState.WITHDRAWN, now, signal=2)

    def restart_slave(self, now: float) -> None:
        """Kill the slave and start it again; its processes keep running."""
        self.incarnation += 1000
        self.fresh = True
        self.sequence = self.batches = 0
        self.said.clear()
        self.ordered.clear()
        self.polled.clear()
        self.slave = SlaveState(max_processes=self.max_processes)
        found = (*self.ends.values(), *self._running())
        reducer.step(self.slave, events.SupervisorReported(found), now)
