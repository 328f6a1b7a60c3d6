"""Simulated cluster for unit tests: the reducers of the master and the slaves, without I/O.

`Cluster` holds time and the wires. A test of one story uses prompt wires: every message arrives at
once and in order (`Cluster.settle`). The state machine test controls the same wires itself: it
delays, loses, repeats and reorders messages.

`Machine` holds the truth of one host: the processes that run there, whatever master and slave
believe.
"""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

import rosrm_criu.plugin
import rosrm_migration.plugin
from rosrm.core.master import events as happened
from rosrm.core.master import listing
from rosrm.core.master.commands import Command, Reply, SendOrder
from rosrm.core.master.invariants import check
from rosrm.core.master.master_state import MasterState
from rosrm.core.master.recovery.restore import restore
from rosrm.core.master.settings import CoreSettings
from rosrm.core.master.state.process import Process
from rosrm.core.slave import events
from rosrm.extensions.contracts import Capabilities, HostView, ProcessView, Scores
from rosrm.extensions.declared_fields import Declared, MaybeCapabilities
from rosrm.extensions.options import merged_options
from rosrm.extensions.placement import PlacementPlugins, ScoringLink, SelectedFilter
from rosrm.extensions.registry import Registry
from rosrm.model.applications import RolloutPolicy, Target
from rosrm.model.codec import to_plain
from rosrm.model.orders import Order
from rosrm.model.plan import (
    AwaitReady,
    AwaitReleased,
    Commit,
    Configure,
    HandoffPhase,
    Move,
    Plan,
    SetRestart,
    Start,
    Stop,
)
from rosrm.model.records import Intent, Record
from rosrm.model.requester import OPERATOR, Requester
from rosrm.model.values import (
    EMPTY,
    InstanceStatus,
    Kind,
    MigrationPolicy,
    ProcessSpec,
    Readiness,
    RestartPolicy,
    SnapshotReport,
)
from rosrm_simulate.world import World
from tests.unit.core.machine import GIB, MIB, Machine
from tests.unit.core.nodes import Air, Node

if TYPE_CHECKING:
    from typing_extensions import Self

__all__ = [
    "GIB",
    "MIB",
    "Cluster",
    "Eq1",
    "HandOver",
    "Machine",
    "StartFirstOrStopFirst",
    "declared_by",
    "job",
    "movable",
    "node",
    "process",
]


# --- fixtures ---------------------------------------------------------------------------------


def job(name: str, memory: float = 0.0, **fields: Any) -> ProcessSpec:
    """Return the spec of a process that runs to completion."""
    return process(name, memory, kind=Kind.JOB, **fields)


def process(name: str, memory: float = 0.0, **fields: Any) -> ProcessSpec:
    """Return the spec of a process; `memory` declares its needs in MiB."""
    if memory:
        fields["needs"] = {"memory": memory * MIB, "cpu": 0.0}
    fields.setdefault("command", ("run", "it"))
    return ProcessSpec(name, **fields)


def node(name: str, **fields: Any) -> ProcessSpec:
    """Return the spec of a ROS node, which is ready once the graph shows it."""
    fields.setdefault("readiness", Readiness(timeout=20.0))
    return process(name, ros=True, **fields)


def movable(name: str, *, overlap: bool = True, **fields: Any) -> ProcessSpec:
    """Return the spec of a process that moves by the strategy `relaunch` of this module."""
    return process(name, migration=MigrationPolicy("relaunch", overlap=overlap), **fields)


class Eq1:
    """Score of the paper with one weight for memory and one for CPU."""

    def __init__(self, memory: float = 1.0, cpu: float = 0.0) -> None:
        self.weights = {"memory": memory, "cpu": cpu}

    def score(self, hosts: HostView, process: ProcessView) -> Scores:
        value = sum(w * hosts.column(name) for name, w in self.weights.items() if w)
        return Scores(np.asarray(value), reason=lambda row: f"{value[row]:.3f} by Eq. 1")


class StartFirstOrStopFirst:
    """Migration strategy like `relaunch`: start first, or stop first without overlap."""

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


class HandOver:
    """Migration strategy like the shipped `handoff`."""

    def __init__(self, timeout: float = 10.0) -> None:
        self.timeout = timeout

    def propose(self, move: Move) -> Plan:
        t, there, here = self.timeout, move.destination_host, move.source_host
        source, destination, policy = move.source, move.destination, move.spec.restart
        alias = f"{move.spec.name}_{move.destination.number}"
        abort, resume = (Configure(p, t) for p in (HandoffPhase.ABORT, HandoffPhase.RESUME))
        stop_there, give_back = Stop(destination, there, t), SetRestart(source, here, policy, t)
        return Plan(
            (
                Start(destination, there, t, alias, undo=stop_there, shadow=True),
                SetRestart(source, here, RestartPolicy("never"), t, undo=give_back),
                Configure(HandoffPhase.SHADOW, t, undo=resume),
                Configure(HandoffPhase.SWITCH, t, undo=abort),
                Commit(),
                SetRestart(destination, there, policy, t),
                AwaitReleased(source, here, t),
                Stop(source, here, t),
                Configure(HandoffPhase.DONE, t),
            )
        )


OrderT = TypeVar("OrderT", bound=Order)

_REGISTRY = Registry.of(migration=rosrm_migration.plugin, criu=rosrm_criu.plugin)
_SHIPPED = {name: _REGISTRY.offer("migration", name) for name in _REGISTRY.names("migration")}
_REGISTRY.calls.limit = lambda _, call: call()  # a busy machine must not change what happens
_CAPABILITIES, _CAPABILITIES_OF = _REGISTRY.capabilities(), _REGISTRY.capabilities_of()


def declared_by(strategies: Mapping[str, Any]) -> Declared:
    """Return the declarations of the shipped strategies: their options and capabilities."""

    def options_of(name: str, spec: ProcessSpec) -> Any:
        offer = _SHIPPED.get(name)
        if offer is None or type(strategies[name]) is not offer.create:
            return None
        cluster = getattr(strategies[name], "_options", offer.options())
        own = spec.migration.options if spec.migration.strategy == name else {}
        return merged_options(offer.own_options or offer.options, to_plain(cluster), own)

    def capabilities_of(spec: ProcessSpec) -> MaybeCapabilities:
        is_shipped = spec.migration.strategy in (None, *_SHIPPED)
        return _CAPABILITIES_OF(spec) if is_shipped else Capabilities()

    return Declared(
        options_of=options_of, capabilities_of=capabilities_of, capabilities=_CAPABILITIES
    )


# --- the cluster ------------------------------------------------------------------------------


class Cluster(World[Machine]):
    """A master's core with machines around it, and prompt wires.

    Attributes:
        now: seconds.
        records: everything that was recorded.
        intents: durable tables, as in the journal: table -> key -> value, as JSON has it.
        carried: every command that was carried out.
        watch: called with the commands of each step before they are carried out.
        boot: id of the boot of the master's machine.
        clock_set_by: seconds by which the master's wall clock was set.
    """

    now = 100.0
    clock_set_by = 0.0
    boot = "of the master's machine"
    checks = 20

    def __init__(
        self, *machines: Machine | str, policy: Any = None, strategies: Mapping[str, Any] = EMPTY,
        fallback: Any = None, reads: tuple[str, ...] = (),
        chain: Sequence[ScoringLink] = (), filters: Sequence[SelectedFilter] = (),
        declared: Declared | None = None, **settings: Any,
    ) -> None:  # fmt: skip
        self.settings = CoreSettings(**{"settle": 1e9, "link_period": 0.0, **settings})
        fallback = ScoringLink(*fallback) if fallback else None
        chain = tuple(chain) or (ScoringLink("eq1", policy or Eq1(), reads=reads),)
        self.placement = lambda: PlacementPlugins(chain, fallback, tuple(filters))
        self.strategies = {"relaunch": StartFirstOrStopFirst(), "handoff": HandOver(), **strategies}
        self.declared = declared or declared_by(self.strategies)
        super().__init__(self._new_state(epoch=1))
        self.air = Air(self.machines.values)
        self.publish = self.air.publish
        self.records: list[Record] = []
        self.intents: dict[str, dict[str, Any]] = defaultdict(dict)
        self.carried: list[Command] = []
        self.watch: Callable[[Sequence[Command]], None] = lambda _: None
        for machine in machines:
            self.add(machine)

    def _new_state(self, epoch: int) -> MasterState:
        state = MasterState(
            self.settings, self.placement(), self.strategies, epoch, declared=self.declared
        )
        state.wall, state.boot = self.wall, self.boot
        return state

    @property
    def wall(self) -> float:
        """Unix time."""
        return 1.7e9 + self.clock_set_by + self.now

    def __getitem__(self, name: str) -> Process:
        return self.state.processes[name]

    # --- commands ------------------------------------------------------------------------

    def record(self, event: happened.Event, commands: Sequence[Command]) -> None:
        """Make the commands durable."""
        self.journal(commands)
        self.watch(commands)
        self.carried += commands

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

    def send(self, sent: SendOrder) -> None:
        self.by_id(sent.host_id).ordered.append(sent)

    # --- machines ------------------------------------------------------------------------

    def add(self, machine: Machine | str) -> Machine:
        """Start a slave, which registers, sends a reading and requests work."""
        machine = Machine(machine) if isinstance(machine, str) else machine
        self.machines[machine.name] = machine
        machine.incarnation = machine.incarnation or 1 + len(self.machines)
        self.register(machine)
        return machine

    def register(
        self, machine: Machine, snapshots: tuple[SnapshotReport, ...] = (), *, journal_seen: int = 0
    ) -> Reply:
        """Register a slave; once accepted, it sends a reading and requests work."""
        reply = self.enter(machine, journal_seen, snapshots)
        if reply.accepted:
            self.read(machine)
            self.ask_for_work(machine)
        self.settle()
        return reply

    def enter(
        self, machine: Machine, journal_seen: int, snapshots: tuple[SnapshotReport, ...]
    ) -> Reply:
        """Register a slave, which sends no reading yet."""
        machine.begin_to_register()
        reply = self.join(machine, self.now, machine.slave.statuses(), journal_seen, snapshots)
        if reply.accepted:
            machine.fresh = machine.leaves = False
            machine.polled.clear()
        return reply

    def ask_for_work(self, machine: Machine) -> None:
        if machine.connected and machine.reading(self.now).accepts:
            self.request(happened.ProcessRequested(0, machine.host_id, machine.incarnation))

    def read(self, *machines: Machine, **wrong: Any) -> None:
        """Send the readings of these (default: all connected) machines as one batch."""
        among = machines or self.machines.values()
        heard = [machine for machine in among if machine.connected and machine.host_id]
        if heard:
            self.tell(self.readings(heard, **wrong))

    def readings(self, hosts: Sequence[Machine], **wrong: Any) -> happened.ReadingsReceived:
        batches = np.array([one.batches for one in hosts], np.uint64)
        return super().readings(hosts, **{"status_sequence": batches, **wrong})

    # --- requests ------------------------------------------------------------------------

    def ask(self, kind: Any, *fields: Any, settle: bool = True) -> Reply:
        """Send a request to the master and return the reply."""
        request = self.request(kind(0, *fields))
        if settle:
            self.settle()
        return self.replies[request]

    def submit(self, *specs: ProcessSpec) -> Reply:
        return self.ask(happened.SubmissionReceived, specs)

    def apply(
        self, name: str, *specs: ProcessSpec, version: int = 0, plan: bool = False,
        by: Requester = OPERATOR, **rollout: Any,
    ) -> Reply:  # fmt: skip
        """Request a version of an application: of these processes, or an earlier one; or none."""
        parts = tuple(replace(spec, application=name) for spec in specs)
        policy = RolloutPolicy(**{"healthy_for": 1.0, **rollout})
        target = Target(name, parts, version, policy)
        return self.ask(happened.ApplicationsRequested, (target,), plan, by)

    def with_processes(self, *specs: ProcessSpec) -> Self:
        """Submit processes, and return the cluster."""
        assert self.submit(*specs).accepted
        return self

    def cancel(self, *names: str) -> Reply:
        return self.ask(happened.CancelRequested, names)

    def restart(self, *names: str) -> Reply:
        return self.ask(happened.RestartRequested, names)

    def migrate(self, name: str, host: str | None = None) -> Reply:
        return self.ask(happened.MigrationRequested, name, host)

    def checkpoint(self, name: str) -> Reply:
        return self.ask(happened.CheckpointRequested, name)

    def restore(self, name: str) -> Reply:
        return self.ask(happened.RestoreRequested, name)

    def set_host(self, host: str, action: str) -> Reply:
        return self.ask(happened.HostStateRequested, host, action)

    def leave(self, host: str) -> Reply:
        """Stop a slave: it announces its departure and ends all its processes."""
        machine = self.machines[host]
        machine.leaves = True
        reply = self.ask(happened.HostLeft, machine.host_id, machine.incarnation, settle=False)
        machine.shut_down(self.now)
        self.settle()
        return reply

    def detach(self, host: str) -> Reply:
        """Stop a slave that leaves its processes running; the host then has no slave."""
        machine = self.machines[host]
        running, machine.leaves = machine.begun(), True
        reply = self.ask(happened.HostLeft, machine.host_id, machine.incarnation, running)
        machine.connected = False
        return reply

    # --- hosts and processes -------------------------------------------------------------

    def cut(self, *hosts: str, seconds: float = 0.0) -> None:
        """Cut hosts off, and let time pass."""
        for host in hosts:
            self.machines[host].connected = False
        self.wait(seconds)

    def reconnect(self, *hosts: str, seconds: float = 0.0) -> None:
        """Repair the wires of hosts, and let time pass."""
        for host in hosts:
            self.machines[host].connected = True
        self.wait(seconds)

    def rejoin(self, host: str, seconds: float = 1.0) -> None:
        """Repair the wires of a host, register its slave again, and let time pass."""
        machine = self.machines[host]
        machine.connected = True
        assert self.register(machine).accepted
        self.wait(seconds)

    def restart_slave(self, host: str) -> Reply:
        """Start another run of a host's slave, which registers; the processes keep running."""
        machine = self.machines[host]
        machine.connected = True
        machine.restart_slave(self.now)
        return self.register(machine)

    def report(self, host: str, *statuses: InstanceStatus, **failing: Mapping[str, str]) -> None:
        """Send a batch of statuses, and the failing probes and strategies of a slave."""
        machine = self.machines[host]
        machine.batches += 1
        self.tell(
            happened.StatusesReceived(
                machine.host_id,
                machine.incarnation,
                machine.batches,
                False,
                statuses,
                devices=machine.devices,
                **failing,
            )
        )

    def finish(self, name: str, on: str = "a", *, code: int = 0, run_time: float = 10.0) -> None:
        """End a process with an exit code, and deliver all messages."""
        self.machines[on].finish(name, self.now, code=code, run_time=run_time)
        self.settle()

    def let_go(self, name: str, on: str = "a") -> None:
        """End a stubborn process, and deliver all messages."""
        self.machines[on].let_go(name, self.now)
        self.settle()

    def discover(self, name: str, on: str = "a") -> None:
        """Show the node of the newest instance in the ROS graph, and deliver all messages."""
        self.machines[on].seen_in_graph(name, self.now)
        self.settle()

    # --- time and wires ------------------------------------------------------------------

    def settle(self) -> None:
        """Deliver all messages until no part sends another one."""
        for _ in range(200):
            said = [self.deliver(machine) for machine in self.machines.values()]
            if not any([*said, self.nodes_talk()]):
                return
        raise AssertionError("the cluster talks without an end")

    def deliver(self, machine: Machine) -> bool:
        """Deliver all messages between the master and a host; return True if there were any."""
        if not machine.connected:
            return False
        busy = bool(machine.polled or machine.ordered or machine.status_batches)
        machine.fetch(self.now)
        while machine.ordered:
            self.tell(machine.obey(machine.ordered.popleft(), self.now))
        while machine.status_batches:
            self.tell(machine.status_batches.popleft())
        return busy

    def nodes_talk(self, *, heard: bool = True) -> bool:
        """Deliver one message to a node, and one report to the master."""
        arrivals, reports = self.air.waiting(), self.air.next_reports()
        for arrive in arrivals[:1]:
            arrive()
        for at in reports[: int(heard)]:
            self.tell(self.air.to_master.pop(at)[1])
        return bool(arrivals or reports)

    def wait(self, seconds: float, *, tick: float = 0.1) -> None:
        """Let time pass: readings and usages arrive, and the reducer checks its deadlines."""
        for _ in range(round(seconds / tick)):
            self.now += tick
            self.read()
            for machine in self.machines.values():
                if machine.connected and machine.host_id:
                    machine.tell(events.TimePassed(), self.now)
                    if machine.host_id not in self.state.hosts.silent_hosts():
                        machine.tell(events.ContactConfirmed(self.now), self.now)
                    self.ask_for_work(machine)
                    self.tell(machine.usages(self.now))
            self.tell(happened.TimePassed())
            self.settle()

    def restart_master(self) -> None:
        """Kill the master, restore it from its journal and register the slaves again."""
        self.kill_master()
        for machine in self.machines.values():
            if machine.connected and machine.host_id:
                self.register(machine)

    def kill_master(self) -> None:
        """Kill the master and restore it from its journal; no slave has registered yet."""
        for machine in self.machines.values():
            machine.polled.clear()
            machine.ordered.clear()
        self.air.master_is_gone()
        self.state = self._new_state(self.state.epoch + 1)
        restore(self.state, lambda table: self.intents[table], self.now)
        check(self.state)

    # --- observations --------------------------------------------------------------------

    def phase(self, name: str) -> str:
        return self[name].phase.value

    def where(self, name: str) -> list[str]:
        """Return the hosts on which instances of a process really run."""
        return [
            machine.name
            for machine in self.machines.values()
            for instance in machine.programs
            if instance.process == name
        ]

    def runs(self, name: str) -> int:
        """Return the number of starts in place of the newest instance, after its first one."""
        programs = {i: it for one in self.machines.values() for i, it in one.programs.items()}
        return programs[max(one for one in programs if one.process == name)].run

    def node(self, host: str, name: str = "p") -> Node:
        """Return the newest node of a process on a host."""
        machine = self.machines[host]
        list(self.air.nodes())
        return machine.programs[machine.find(name)].node

    def active(self, name: str = "p") -> list[str]:
        """Return the hosts on which a node of the process really is active."""
        return [
            machine.name
            for machine, node in self.air.nodes()
            if node.instance.process == name and node.active
        ]

    def counts(self) -> dict[str, int]:
        """Return the number of processes that really run, by host."""
        return {name: len(machine.programs) for name, machine in self.machines.items()}

    def queue(self) -> list[str]:
        return list(self.state.queue)

    def recorded(self, kind: str) -> list[str]:
        """Return the messages of the records of a kind."""
        return [record.message for record in self.records if record.kind == kind]

    def assigned(self) -> list[str]:
        """Return process names in the order of their assignment."""
        return [record.process for record in self.records if record.kind == "assigned"]

    def explain(self, name: str) -> dict[str, Any]:
        story = listing.explanation(self.state, name, self.now)
        assert story is not None
        return json.loads(json.dumps(story, default=dict))

    def orders(self, kind: type[OrderT]) -> list[OrderT]:
        return [sent.order for sent in self.sent() if isinstance(sent.order, kind)]

    def sent(self, *kinds: type[Order]) -> list[SendOrder]:
        """Return all orders of these kinds; without a kind, all orders."""
        sent = [c for c in self.carried if isinstance(c, SendOrder)]
        return [one for one in sent if not kinds or isinstance(one.order, kinds)]
