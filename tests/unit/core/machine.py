"""Simulated host for unit tests: its running processes, its slave, and the wires to the master."""

from __future__ import annotations

from collections import Counter, defaultdict, deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from rosrm.core.master import events as happened
from rosrm.core.master.commands import OrderId, SendOrder
from rosrm.core.slave import events, reducer
from rosrm.core.slave.state import SlaveState
from rosrm.core.slave.watches import Memo
from rosrm.model.orders import DropReplica, MeasureLinks, ReplicateSnapshot, RunExecutor
from rosrm.model.values import (
    Assignment,
    HostDescription,
    InstanceId,
    InstanceState,
    InstanceStatus,
    ResourceDescription,
    RestartPolicy,
    SnapshotReport,
)
from rosrm_simulate import host
from rosrm_simulate.host import Host, SimulatedReading
from tests.unit.core.nodes import Node

MIB = 2.0**20
GIB = 2.0**30


@dataclass(kw_only=True)
class Program(host.Program):
    """Instance that really runs.

    Attributes:
        node: present run of the node, if it can be moved with its state.
        run_time: seconds that its end reports.
    """

    node: Node
    run_time: float = 10.0


@dataclass
class Machine(Host[Program]):
    """Simulated host on which nothing takes time, with the wires from and to the master.

    Attributes:
        refuses: process name to the reason why it cannot be started here.
        stubborn: process names that do not end when ordered to stop.
        quirks: of the nodes of a process here, by process name; see `Node`.
        shown: base units that each process uses, by name; shows in readings and usages.
        ordered: orders on their way to the slave.
        snapshots: newest snapshot or replica of each process on this host, by process name.
        ships: hosts that receive replicas of a process on this host, by process name.
        connected: True while the wires work.
        takes: False for a slave that accepts no work.
        leaves: True while its slave stops, from before the master learns it.
        ordered_restarts: number of restarts by order of each process here, by name.
        measures: returns the JSON of the report on links; None: its slave refuses the order.
    """

    memory: float = 16 * GIB
    cpu: float = 8.0
    limits: Mapping[str, float] = field(default_factory=lambda: {"memory": 0.8, "cpu": 0.9})
    executors: dict[str, Callable[[Mapping[str, Any]], Any]] = field(default_factory=dict)
    refuses: dict[str, str] = field(default_factory=dict)
    stubborn: set[str] = field(default_factory=set)
    quirks: dict[str, set[str]] = field(default_factory=lambda: defaultdict(set))
    busy: dict[str, float] = field(default_factory=lambda: {"memory": 0.1, "cpu": 0.1})
    shown: dict[str, dict[str, float]] = field(default_factory=lambda: defaultdict(dict))
    ordered: deque[SendOrder] = field(default_factory=deque)
    snapshots: dict[str, SnapshotReport] = field(default_factory=dict)
    ships: dict[str, tuple[str, ...]] = field(default_factory=dict)
    connected: bool = True
    takes: bool = True
    leaves: bool = False
    measures: Callable[[MeasureLinks], Mapping[str, Any]] | None = None
    fresh: bool = False
    ordered_restarts: Counter[str] = field(default_factory=Counter)

    def __post_init__(self) -> None:
        self.resources = self.resources or (
            ResourceDescription("memory", "B", self.memory),
            ResourceDescription("cpu", "core", self.cpu),
        )
        super().__post_init__()

    # --- messages to the master ----------------------------------------------------------

    def description(self) -> HostDescription:
        known = {"hostname": f"{self.name}.local", "pid": 7, "executors": tuple(self.executors)}
        return replace(super().description(), **known)

    def begin_to_register(self) -> None:
        """Start a registration: a new run of the slave drops orders meant for the former run."""
        if self.fresh:
            self.ordered.clear()

    def reading(self, now: float) -> SimulatedReading:
        reading = super().reading(now)
        return reading._replace(accepts=self.takes and not self.leaves and reading.accepts)

    def used_by(self, program: Program, now: float) -> dict[str, float]:
        return self.shown[program.assignment.instance.process]

    # --- programs --------------------------------------------------------------------------

    def make_program(self, assignment: Assignment, restart: RestartPolicy) -> Program:
        silent = assignment.shadow or assignment.restored
        node = Node(assignment.instance, silent, self.quirks[assignment.instance.process])
        return Program(assignment=assignment, restart=restart, pid=self.next_pid(), node=node)

    def run_begins_again(self, program: Program, now: float) -> None:
        instance = program.assignment.instance
        program.node = Node(instance, False, self.quirks[instance.process])

    def spent(self, program: Program, now: float) -> tuple[float, float, float]:
        used, run_time = self.used_by(program, now), program.run_time
        return run_time, used.get("memory", 0.0), run_time * used.get("cpu", 0.0)

    def _launch(self, assignment: Assignment, now: float) -> None:
        reason = self.refuses.get(assignment.instance.process)
        if reason is None:
            super()._launch(assignment, now)
        else:
            self.tell(events.LaunchRefused(assignment.instance, reason), now)

    def _stop(self, instance: InstanceId, now: float) -> None:
        """Stop a program, which may be stubborn; a later order ends it unless it still is."""
        program = self.programs.get(instance)
        if program is not None and program.state is InstanceState.STOPPING:
            self._stopped(instance, now)
        super()._stop(instance, now)

    def _stopped(self, instance: InstanceId, now: float) -> None:
        if instance.process not in self.stubborn:
            super()._stopped(instance, now)

    def _restart(self, instance: InstanceId, now: float, *, by_policy: bool = False) -> None:
        self.ordered_restarts[instance.process] += not by_policy
        super()._restart(instance, now, by_policy=by_policy)

    def find(self, name: str) -> InstanceId:
        """Return the newest running instance of a process."""
        return max(one for one in self.programs if one.process == name)

    def finish(self, name: str, now: float, *, code: int = 0, run_time: float = 10.0) -> None:
        """End a process with an exit code; its restart policy may start it again."""
        instance = self.find(name)
        program = self.programs[instance]
        if program.restart.when == "always" or (program.restart.when == "on-failure" and code):
            self._restart(instance, now, by_policy=True)
            return
        program.run_time = run_time
        state = InstanceState.EXITED if code == 0 else InstanceState.FAILED
        self._end(instance, state, now, code=code)

    def let_go(self, name: str, now: float) -> None:
        """End a stubborn process."""
        self.stubborn.discard(name)
        self._end(self.find(name), InstanceState.EXITED, now, signal=9)

    def seen_in_graph(self, name: str, now: float) -> None:
        """Show the node of the newest instance in the ROS graph."""
        self.tell(events.SeenInGraph(self.find(name)), now)

    # --- executors and snapshots ---------------------------------------------------------

    def execute(self, order_id: OrderId, order: RunExecutor) -> happened.OrderAnswered:
        try:
            result = self.executors[order.executor](order.arguments)
        except Exception as error:  # noqa: BLE001 - what a test's executor does
            return happened.OrderAnswered(order_id, False, "failed", str(error))
        if not isinstance(result, Mapping):
            return happened.OrderAnswered(order_id, False, happened.BAD_RESULT, "no object")
        return happened.OrderAnswered(order_id, True, result=result)

    def measure(self, order_id: OrderId, order: MeasureLinks) -> happened.OrderAnswered:
        if self.measures is None:
            return super().measure(order_id, order)
        return happened.OrderAnswered(order_id, True, result=self.measures(order))

    def replicate(self, order: ReplicateSnapshot | DropReplica) -> None:
        name = order.instance.process
        if isinstance(order, ReplicateSnapshot):
            self.ships[name] = order.hosts
        elif (
            name in self.snapshots and self.snapshots[name].instance.number <= order.instance.number
        ):
            del self.snapshots[name]

    def publish_snapshot(self, instance: InstanceId) -> SnapshotReport:
        """Publish a snapshot that is newer than the one before."""
        before = self.snapshots.get(instance.process)
        cycles = before.sequence if before is not None and before.instance == instance else 0
        self.snapshots[instance.process] = SnapshotReport(instance, cycles + 1, 100)
        return self.snapshots[instance.process]

    def take_state(self, state: SnapshotReport) -> None:
        """Receive a replica from another host; the slave keeps only the newest."""
        own = self.snapshots.get(state.instance.process)
        age = (state.instance.number, state.sequence)
        if own is None or (own.instance.number, own.sequence) < age:
            self.snapshots[state.instance.process] = state

    # --- the slave and its supervisor -----------------------------------------------------

    def fetch(self, now: float) -> None:
        """Answer the slave's open request with the assignments that wait for it."""
        batch, self.polled = self.polled, []
        if batch:
            self.tell(events.AssignmentsReceived(tuple(batch)), now)

    def replace_supervisor(self, now: float) -> None:
        """Kill the supervisor; the next one adopts what runs and remembers what ended."""
        fenced = {one for one, it in self.programs.items() if it.assignment.fence is not None}
        statuses = (*self.ends.values(), *self._running())
        self.tell(events.SupervisorReplaced(statuses, self._memos(), frozenset(fenced)), now)

    def report_devices(self) -> None:
        """Report the devices of the host as they are now."""
        self.batches += 1
        self.say(
            happened.StatusesReceived(
                self.host_id, self.incarnation, self.batches, False, (), devices=self.devices
            )
        )

    def _memos(self) -> dict[InstanceId, Memo]:
        held = self.slave.held
        return {
            one: Memo(
                devices=it.assignment.devices,
                lifecycle=held[one].lifecycle if one in held else None,
            )
            for one, it in self.programs.items()
        }

    def _running(self) -> list[InstanceStatus]:
        return [
            InstanceStatus(instance, program.state, pid=program.pid, restarts=program.restarts)
            for instance, program in self.programs.items()
        ]

    def begun(self) -> tuple[InstanceStatus, ...]:
        """Return the statuses of all instances, except of those that wait for their start."""
        waiting = self.slave.waiting
        return tuple(one for one in self.slave.statuses() if one.instance not in waiting)

    def stop_unreachable(self, now: float) -> None:
        """Stop the slave while the master receives none of its messages; it ends all processes."""
        for instance in list(self.programs):
            self._end(instance, InstanceState.WITHDRAWN, now, signal=2)

    def restart_slave(self, now: float) -> None:
        """Kill the slave and start it again; its processes keep running."""
        self.incarnation += 1000
        self.fresh, self.leaves = True, False
        self.sequence = self.batches = 0
        self.status_batches.clear()
        self.ordered.clear()
        self.polled.clear()
        memos = self._memos()  # of the former run
        self.slave = SlaveState(max_processes=self.max_processes)
        found = (*self.ends.values(), *self._running())
        reducer.step(self.slave, events.SupervisorReplaced(found, memos), now)
