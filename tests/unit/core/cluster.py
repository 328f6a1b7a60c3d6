"""A cluster on a table: the master's core, the slaves' cores, and machines that a test plays with.

`Cluster` holds time and the wires. In a test of one story the wires are prompt: whatever is said is
heard at once and in order (`Cluster.settle`). The state machine test takes the same wires in hand,
and delays, loses, repeats and mixes up what travels.

`Machine` is the truth of one host: the processes that really run there, whatever anybody believes.
"""

from __future__ import annotations

import json
from collections import defaultdict, deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from rosrm.core import events as happened
from rosrm.core import listing, slave
from rosrm.core.commands import Assign, Command, Order, Reply, Withdraw
from rosrm.core.master import step
from rosrm.core.migration import AwaitReady, Commit, Move, Plan, Start, Stop
from rosrm.core.model import (
    EMPTY,
    RESOURCE_SLOTS,
    Assignment,
    HostDescription,
    InstanceId,
    InstanceState,
    InstanceStatus,
    Kind,
    MigrationPolicy,
    ProcessSpec,
    Readiness,
    ResourceDescription,
)
from rosrm.core.restore import restore
from rosrm.core.settings import CoreSettings
from rosrm.core.state import MasterState, Process
from rosrm.ports import HostView, Intent, ProcessView, Record, Scores

MIB = 2.0**20
GIB = 2.0**30


# --- things to begin with ---------------------------------------------------------------------


def job(name: str, **fields: Any) -> ProcessSpec:
    """A process that runs to completion."""
    return process(name, kind=Kind.JOB, **fields)


def process(name: str, memory: float = 0.0, **fields: Any) -> ProcessSpec:
    """A process; `memory` declares its need in MiB."""
    if memory:
        fields["needs"] = {"memory": memory * MIB, "cpu": 0.0}
    fields.setdefault("command", ("run", "it"))
    return ProcessSpec(name, **fields)


def node(name: str, **fields: Any) -> ProcessSpec:
    """A ROS node: it is ready once it is seen in the graph."""
    fields.setdefault("readiness", Readiness(timeout=20.0))
    return process(name, ros=True, **fields)


def movable(name: str, *, overlap: bool = True, **fields: Any) -> ProcessSpec:
    """A process that may be moved by the strategy `relaunch` of this module."""
    return process(name, migration=MigrationPolicy("relaunch", overlap=overlap), **fields)


class Eq1:
    """The paper's score with one weight for memory and one for CPU."""

    def __init__(self, memory: float = 1.0, cpu: float = 0.0) -> None:
        self.weights = {"memory": memory, "cpu": cpu}

    def score(self, hosts: HostView, process: ProcessView) -> Scores:
        value = sum(w * hosts.column(name) for name, w in self.weights.items() if w)
        return Scores(np.asarray(value), reason=lambda row: f"{value[row]:.3f} by Eq. 1")


class StartFirstOrStopFirst:
    """As the shipped `relaunch`: start first, or stop first where two are not allowed."""

    def __init__(self, timeout: float = 10.0) -> None:
        self.timeout = timeout

    def propose(self, move: Move) -> Plan:
        t, there, here = self.timeout, move.destination_host, move.source_host
        stop_there = Stop(move.destination, there, t)
        start = Start(move.destination, there, t, undo=stop_there)
        ready = AwaitReady(move.destination, there, t)
        if move.spec.migration.overlap:
            stop = Stop(move.source, here, t)
            return Plan((start, ready, Commit(), stop), overlap=2 * t)
        stop = Stop(move.source, here, t, undo=Start(move.fallback, here, t))
        return Plan((stop, start, ready, Commit()))


# --- a machine --------------------------------------------------------------------------------


@dataclass
class Program:
    """One instance that really runs."""

    assignment: Assignment
    state: InstanceState = InstanceState.RUNNING
    pid: int = 0


@dataclass
class Machine:
    """One host: what runs there, its slave, and the wires from and to it.

    Attributes:
        programs: what really runs, by instance; outlives the slave.
        ends: of instances that the supervisor remembers.
        refuses: process name to the reason why it cannot be started here.
        stubborn: process names that do not end when they are told to.
        busy: usage of each resource without our processes, fraction.
        shown: base units that each process uses, by name; shows in readings and usages.
        polled: assignments that wait for the slave's next request, in the master's hands.
        ordered: orders on their way to the slave.
        said: status batches on their way to the master.
        connected: the wires work.
    """

    name: str
    memory: float = 16 * GIB
    cpu: float = 8.0
    limits: Mapping[str, float] = field(default_factory=lambda: {"memory": 0.8, "cpu": 0.9})
    labels: Mapping[str, str] = field(default_factory=lambda: EMPTY)
    max_processes: int = 0
    resources: tuple[ResourceDescription, ...] = ()
    executors: dict[str, Callable[[Mapping[str, Any]], Any]] = field(default_factory=dict)

    host_id: int = 0
    incarnation: int = 0
    slave: slave.SlaveState = field(default_factory=slave.SlaveState)
    programs: dict[InstanceId, Program] = field(default_factory=dict)
    ends: dict[InstanceId, InstanceStatus] = field(default_factory=dict)
    refuses: dict[str, str] = field(default_factory=dict)
    stubborn: set[str] = field(default_factory=set)
    busy: dict[str, float] = field(default_factory=lambda: {"memory": 0.1, "cpu": 0.1})
    shown: dict[str, dict[str, float]] = field(default_factory=lambda: defaultdict(dict))
    polled: list[Assignment] = field(default_factory=list)
    ordered: deque[Order] = field(default_factory=deque)
    said: deque[happened.StatusesReceived] = field(default_factory=deque)
    connected: bool = True
    takes: bool = True
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

    # --- what it says --------------------------------------------------------------------

    def description(self) -> HostDescription:
        return HostDescription(
            self.name, self.incarnation, hostname=f"{self.name}.local", pid=7, labels=self.labels,
            resources=self.resources, max_processes=self.max_processes,
            executors=tuple(self.executors),
        )  # fmt: skip

    def usage(self) -> dict[str, float]:
        """Fraction of each resource, our running processes included."""
        usage = dict(self.busy)
        for program in self.programs.values():
            for resource in self.resources:
                amount = self.shown[program.assignment.instance.process].get(resource.name, 0.0)
                usage[resource.name] = usage.get(resource.name, 0.0) + amount / resource.capacity
        return usage

    def limit(self, resource: str) -> float:
        return self.limits.get(resource, 1.0)

    def accepts(self) -> bool:
        """Under all its limits, as the slave judges it."""
        usage = self.usage()
        return self.takes and all(
            usage.get(one.name, 0.0) < self.limit(one.name) for one in self.resources
        )

    def usages(self) -> happened.UsagesReceived:
        """What each of its instances uses."""
        held = list(self.programs)
        used = [self.shown[one.process] for one in held]
        return happened.UsagesReceived(
            self.host_id, self.incarnation,
            np.array([one.number for one in held], np.uint64),
            np.array([one.get("cpu", 0.0) for one in used]),
            np.array([one.get("memory", 0.0) for one in used]),
        )  # fmt: skip

    def _report(self, commands: Iterable[slave.Command], now: float) -> None:
        for command in commands:
            if isinstance(command, slave.Report):
                self.batches += 1
                self.said.append(
                    happened.StatusesReceived(
                        self.host_id, self.incarnation, self.batches, command.complete,
                        command.statuses,
                    )
                )  # fmt: skip
            elif isinstance(command, slave.Launch):
                for assignment in command.assignments:
                    self._launch(assignment, now)
            elif isinstance(command, slave.Stop):
                self._stop(command.instance, now)
            elif isinstance(command, slave.Restart):
                self._restart(command.instance, now)
            elif isinstance(command, slave.Forget):
                for instance in command.instances:
                    self.ends.pop(instance, None)

    def tell(self, event: slave.Event, now: float) -> None:
        """Something happens to the slave."""
        self._report(slave.step(self.slave, event, now), now)

    def _supervisor_says(self, status: InstanceStatus, now: float) -> None:
        self.tell(slave.SupervisorReported((status,)), now)

    # --- what it does --------------------------------------------------------------------

    def _launch(self, assignment: Assignment, now: float) -> None:
        instance = assignment.instance
        reason = self.refuses.get(instance.process)
        if reason is not None:
            self.tell(slave.LaunchRefused(instance, reason), now)
            return
        self.pids += 1
        self.programs[instance] = Program(assignment, pid=self.pids)
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
        """The newest running instance of a process."""
        return max(one for one in self.programs if one.process == name)

    def finish(self, name: str, now: float, *, code: int = 0, run_time: float = 10.0) -> None:
        """A process ends by itself."""
        state = InstanceState.EXITED if code == 0 else InstanceState.FAILED
        self._end(self.find(name), state, now, code=code, run_time=run_time)

    def let_go(self, name: str, now: float) -> None:
        """A stubborn process ends at last."""
        self.stubborn.discard(name)
        self._end(self.find(name), InstanceState.EXITED, now, signal=9)

    def seen_in_graph(self, name: str, now: float) -> None:
        """The node of the newest instance comes up."""
        self.tell(slave.SeenInGraph(self.find(name)), now)

    def obey(self, order: Order, now: float) -> happened.OrderAnswered:
        """The slave takes an order."""
        if order.action == "execute":
            accepted, message = True, ""
            try:
                self.executors[order.executor](order.arguments)
            except Exception as error:  # noqa: BLE001 - what a test's executor does
                accepted, message = False, str(error)
            return happened.OrderAnswered(
                order.order, accepted, "" if accepted else "failed", message
            )
        event: slave.Event
        if order.action == "report":
            event = slave.ReportRequested()
        elif order.action == "start":
            assert order.assignment is not None
            event = slave.AssignmentsReceived((order.assignment,))
        else:
            assert order.instance is not None
            kinds = {"stop": slave.StopOrdered, "restart": slave.RestartOrdered}
            event = kinds[order.action](order.instance)
        self.tell(event, now)
        return happened.OrderAnswered(order.order, accepted=True)

    def fetch(self, now: float) -> None:
        """The slave's open request is answered with what waits for it."""
        batch, self.polled = self.polled, []
        if batch:
            self.tell(slave.AssignmentsReceived(tuple(batch)), now)

    def restart_slave(self, now: float) -> None:
        """The slave is killed and comes up again; what runs, runs on."""
        self.incarnation += 1000
        self.sequence = self.batches = 0
        self.said.clear()
        self.ordered.clear()
        self.polled.clear()
        self.slave = slave.SlaveState(max_processes=self.max_processes)
        found = [
            InstanceStatus(instance, program.state, pid=program.pid)
            for instance, program in self.programs.items()
        ]
        slave.step(self.slave, slave.SupervisorReported((*self.ends.values(), *found)), now)


# --- the cluster ------------------------------------------------------------------------------


class Cluster:
    """A master's core with machines around it.

    Attributes:
        now: seconds.
        records: everything that was recorded.
        intents: what is durable: table -> key -> value, as JSON has it.
        replies: by request.
        carried: every command that was carried out.
    """

    def __init__(
        self, *machines: Machine | str, policy: Any = None, strategies: Mapping[str, Any] = EMPTY,
        fallback: Any = None, **settings: Any,
    ) -> None:  # fmt: skip
        self.now = 100.0
        self.settings = CoreSettings(**{"settle": 1e9, **settings})
        self.policy = policy or Eq1()
        self.fallback = fallback
        self.strategies = {"relaunch": StartFirstOrStopFirst(), **strategies}
        self.state = self._new_state(epoch=1)
        self.machines: dict[str, Machine] = {}
        self.records: list[Record] = []
        self.intents: dict[str, dict[str, Any]] = defaultdict(dict)
        self.replies: dict[int, Reply] = {}
        self.carried: list[Command] = []
        self._requests = 0
        for machine in machines:
            self.add(machine)

    def _new_state(self, epoch: int) -> MasterState:
        return MasterState(self.settings, "eq1", self.policy, self.strategies, epoch, self.fallback)

    def __getitem__(self, name: str) -> Process:
        return self.state.processes[name]

    # --- events --------------------------------------------------------------------------

    def decide(self, event: happened.Event) -> list[Command]:
        """The core takes an event in; nothing of the outcome is carried out."""
        return step(self.state, event, self.now)

    def tell(self, event: happened.Event) -> list[Command]:
        """The core takes an event in; the outcome is made durable and carried out."""
        commands = self.decide(event)
        self.journal(commands)
        self.carry_out(commands)
        return commands

    def journal(self, commands: Iterable[Command]) -> None:
        for command in commands:
            if isinstance(command, Record):
                json.dumps(command.facts, default=dict)
                self.records.append(command)
            elif isinstance(command, Intent):
                if command.value is None:
                    self.intents[command.table].pop(command.key, None)
                else:
                    plain = json.loads(json.dumps(command.value, default=dict))
                    self.intents[command.table][command.key] = plain

    def carry_out(self, commands: Iterable[Command]) -> None:
        for command in commands:
            self.carried.append(command)
            if isinstance(command, Reply):
                self.replies[command.request] = command
            elif isinstance(command, Assign):
                self.by_id(command.host_id).polled.append(command.assignment)
            elif isinstance(command, Order):
                self.by_id(command.host_id).ordered.append(command)
            elif isinstance(command, Withdraw):
                self._withdraw(command)

    def _withdraw(self, command: Withdraw) -> None:
        machine = self.by_id(command.host_id)
        kept = [one for one in machine.polled if one.instance != command.instance]
        if len(kept) < len(machine.polled):
            machine.polled = kept
            self.tell(happened.AssignmentWithdrawn(command.instance))
        else:
            machine.ordered.append(Order(command.order, command.host_id, "stop", command.instance))

    def by_id(self, host_id: int) -> Machine:
        name = self.state.hosts.hosts[host_id - 1].name
        return self.machines[name]

    # --- machines ------------------------------------------------------------------------

    def add(self, machine: Machine | str) -> Machine:
        """A slave comes up, registers, sends a reading and asks for work."""
        machine = Machine(machine) if isinstance(machine, str) else machine
        self.machines[machine.name] = machine
        machine.incarnation = machine.incarnation or 1 + len(self.machines)
        self.register(machine)
        return machine

    def register(self, machine: Machine) -> Reply:
        """A slave registers; taken in, it sends a reading and asks for work."""
        reply = self.ask(
            happened.HostRegistered, machine.description(), machine.slave.statuses(), settle=False
        )
        if reply.accepted:
            machine.host_id = reply.host_id
            machine.polled.clear()
            machine.tell(slave.Registered(self.state.epoch), self.now)
            self.read(machine)
            self.ask_for_work(machine)
        self.settle()
        return reply

    def ask_for_work(self, machine: Machine) -> None:
        if machine.connected and machine.accepts():
            self._requests += 1
            self.tell(
                happened.ProcessRequested(self._requests, machine.host_id, machine.incarnation)
            )

    def read(self, *machines: Machine, **wrong: Any) -> None:
        """Readings of these machines (of all that are connected) reach the master as one batch."""
        among = machines or self.machines.values()
        heard = [machine for machine in among if machine.connected and machine.host_id]
        if heard:
            self.tell(self.readings(heard, **wrong))

    def readings(self, machines: Sequence[Machine], **wrong: Any) -> happened.ReadingsReceived:
        n = len(machines)
        usage, limit = np.zeros((n, RESOURCE_SLOTS)), np.ones((n, RESOURCE_SLOTS))
        stale = np.zeros(n, np.uint32)
        for row, machine in enumerate(machines):
            machine.sequence += 1
            now = machine.usage()
            for slot, resource in enumerate(machine.resources):
                usage[row, slot] = now.get(resource.name, 0.0)
                limit[row, slot] = machine.limit(resource.name)
                stale[row] |= (resource.name in machine.stale) << slot
        columns: dict[str, Any] = {
            "host_id": np.array([m.host_id for m in machines], np.int64),
            "incarnation": np.array([m.incarnation for m in machines], np.uint64),
            "sequence": np.array([m.sequence for m in machines], np.uint64),
            "status_sequence": np.array([m.batches for m in machines], np.uint64),
            "accepting": np.array([m.accepts() for m in machines], np.bool_),
            "stale": stale, "usage": usage, "limit": limit,
        }  # fmt: skip
        return happened.ReadingsReceived(**{**columns, **wrong})

    # --- requests ------------------------------------------------------------------------

    def ask(self, kind: Any, *fields: Any, settle: bool = True) -> Reply:
        """Somebody asks for something; the answer."""
        self._requests += 1
        request = self._requests
        self.tell(kind(request, *fields))
        if settle:
            self.settle()
        return self.replies[request]

    def submit(self, *specs: ProcessSpec) -> Reply:
        return self.ask(happened.SubmissionReceived, specs)

    def cancel(self, *names: str) -> Reply:
        return self.ask(happened.CancelRequested, names)

    def restart(self, *names: str) -> Reply:
        return self.ask(happened.RestartRequested, names)

    def migrate(self, name: str, host: str | None = None) -> Reply:
        return self.ask(happened.MigrationRequested, name, host)

    def set_host(self, host: str, action: str) -> Reply:
        return self.ask(happened.HostStateRequested, host, action)

    def leave(self, machine: Machine) -> Reply:
        """A slave says that it stops, then ends all that it runs."""
        reply = self.ask(happened.HostLeft, machine.host_id, machine.incarnation, settle=False)
        for instance in list(machine.programs):
            machine.tell(slave.StopOrdered(instance), self.now)
        self.settle()
        return reply

    # --- time and wires ------------------------------------------------------------------

    def settle(self) -> None:
        """Everything that is on its way arrives, until nothing more is said."""
        for _ in range(200):
            if not any(self._deliver(machine) for machine in self.machines.values()):
                return
        raise AssertionError("the cluster talks without an end")

    def _deliver(self, machine: Machine) -> bool:
        if not machine.connected:
            return False
        busy = bool(machine.polled or machine.ordered or machine.said)
        machine.fetch(self.now)
        while machine.ordered:
            self.tell(machine.obey(machine.ordered.popleft(), self.now))
        while machine.said:
            self.tell(machine.said.popleft())
        return busy

    def wait(self, seconds: float, *, tick: float = 0.1) -> None:
        """Time passes: readings and usages come, deadlines are looked at."""
        for _ in range(round(seconds / tick)):
            self.now += tick
            self.read()
            for machine in self.machines.values():
                if machine.connected and machine.host_id:
                    machine.tell(slave.TimePassed(), self.now)
                    self.ask_for_work(machine)
                    self.tell(machine.usages())
            self.tell(happened.TimePassed())
            self.settle()

    def restart_master(self) -> None:
        """The master is killed and comes up from its journal; the slaves register again."""
        self.kill_master()
        for machine in self.machines.values():
            if machine.connected and machine.host_id:
                self.register(machine)

    def kill_master(self) -> None:
        """The master is killed and comes up from its journal; it has heard nobody yet."""
        for machine in self.machines.values():
            machine.polled.clear()
            machine.ordered.clear()
        self.state = self._new_state(self.state.epoch + 1)
        restore(self.state, lambda table: self.intents[table], self.now)

    # --- what is to be seen --------------------------------------------------------------

    def phase(self, name: str) -> str:
        return self[name].phase.value

    def where(self, name: str) -> list[str]:
        """Hosts on which instances of a process really run."""
        return [
            machine.name
            for machine in self.machines.values()
            for instance in machine.programs
            if instance.process == name
        ]

    def counts(self) -> dict[str, int]:
        """Processes that really run, by host."""
        return {name: len(machine.programs) for name, machine in self.machines.items()}

    def queue(self) -> list[str]:
        return list(self.state.queue)

    def told(self, kind: str) -> list[str]:
        """Messages of the records of a kind."""
        return [record.message for record in self.records if record.kind == kind]

    def assigned(self) -> list[str]:
        """Names in the order in which they were assigned."""
        return [record.process for record in self.records if record.kind == "assigned"]

    def explain(self, name: str) -> dict[str, Any]:
        story = listing.explanation(self.state, name, self.now)
        assert story is not None
        return json.loads(json.dumps(story, default=dict))

    def orders(self, action: str) -> list[Order]:
        return [c for c in self.carried if isinstance(c, Order) and c.action == action]
