"""State machine test of the master's core: invariants under random events.

Hypothesis plays users, machines, processes and the network. It submits, cancels, moves, cuts wires,
loses, repeats and delays messages, and kills slaves and the master. `Machine` records the processes
that really run, independently of the core's state. After every step the invariants compare the two.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule

from rosrm.core.master import events as happened
from rosrm.core.master.assignment.demands import demand_of
from rosrm.core.master.checkpoint.replication import awaits_states
from rosrm.core.master.commands import Assign, Command
from rosrm.core.master.invariants import check
from rosrm.core.master.master_state import MasterState
from rosrm.core.master.state.hosts import HostCondition, HostTable
from rosrm.core.master.state.process import DesiredState, ProcessPhase
from rosrm.core.slave import events
from rosrm.extensions.contracts import CheckpointChoice, CheckpointView
from rosrm.model.arrays import NO_ARRAY, ArrayMembership
from rosrm.model.devices import Device, DeviceNeed
from rosrm.model.event_kinds import EventKind
from rosrm.model.records import Record
from rosrm.model.schedules import NO_SCHEDULE, Schedule
from rosrm.model.values import (
    GroupMembership,
    HostLossPolicy,
    InstanceState,
    Kind,
    LifecyclePolicy,
    MigrationPolicy,
    ProcessSpec,
    Readiness,
    ReschedulePolicy,
    RestartPolicy,
    SnapshotReport,
    StandbyPolicy,
    StartOrder,
)
from rosrm_migration.lifecycle_node import LifecycleNode, LifecycleNodeOptions
from tests.unit.core.cluster import MIB, Cluster, HandOver, Machine, StartFirstOrStopFirst
from tests.unit.core.nodes import QUIRKS, Node
from tests.unit.core.portable import Everywhere, Portable

NAMES = [f"p{i}" for i in range(5)]
TWINS = [f"{name}x" for name in NAMES]
HOSTS = ["a", "b", "c"]
LABELLED = "c"

# Few names are frequent, so that many events hit the same process.
names = st.sampled_from([*NAMES[:1] * 4, *NAMES[:2] * 2, *NAMES])
hosts = st.sampled_from(HOSTS)
ways = st.sampled_from(
    [
        "overlap",
        "stop first",
        "handoff",
        "handoff, restarted",
        "handoff, standby",
        "criu",
        "lifecycle_node",
    ]
)
losses = st.sampled_from(["wait", "wait", "elsewhere", "elsewhere", "stop"])
chance = st.booleans()
kinds = st.sampled_from(["service", "job", "node", "node"])
#: Start orders that a process may have, to be completed with a dependency.
starts = st.sampled_from(["ready", "finished", "ready, later", "ready, restart"])
asked = st.sampled_from(["", "", "camera", "gpu", "half gpu", "half gpu"])
NEEDS = {
    "": (),
    "camera": (DeviceNeed("camera"),),
    "gpu": (DeviceNeed("gpu"), DeviceNeed("lidar")),
    "half gpu": (DeviceNeed("gpu", 0.5),),
}
#: How the processes of one submission are related, to the group of the first one.
GROUPS = {
    "": GroupMembership(),
    "gang": GroupMembership(),
    "group": GroupMembership("d"),
    "ends group": GroupMembership("d", "always"),
}
GPU = Device("gpu", "0")
DEVICES = {
    "a": (Device("camera", "front"), GPU),
    "b": (Device("camera", "rear"), GPU, Device("gpu", "1"), Device("lidar", "x", shareable=2)),
    "c": (GPU, Device("lidar", "x")),
}
HOST_CHANGES = [
    "cut", "mended", "killed", "killed", "leaves", "stops unreachable", "is detached",
    "loses power", "loses a poll", "full", "over", "empty", "another supervisor", "breaks", "works",
]  # fmt: skip
#: Index of one of the present things; `Play.pick` takes it modulo their number.
which_one = st.integers(0, 11)
#: Seconds of contact with a host after which no fenced instance runs there any more.
FENCED_WITHIN = 1.0


def is_open(hosts: HostTable, column: int) -> bool:
    """Return True if a host may take work at all; independent of the filters."""
    is_up = hosts.condition[column] == HostCondition.UP and not hosts.closed[column]
    has_told = not hosts.report_due[column] and not hosts.stale[column]
    return bool(is_up and has_told and hosts.accepting[column] and hosts.asking[column])


def spec(
    name: str, kind: str, memory: int, moves: str, special: bool, priority: int,
    loss: str = "wait", devices: str = "", start_order: StartOrder | None = None,
    related: str = "",
) -> ProcessSpec:  # fmt: skip
    """Draw one of a few sorts of process."""
    word = moves.partition(",")[0]
    strategy = word if word in ("handoff", "criu", "lifecycle_node") else "relaunch"
    managed = word == "lifecycle_node" and kind == "node"
    migration = MigrationPolicy(strategy, overlap=moves == "overlap") if moves else None
    restart = RestartPolicy("on-failure" if moves == "handoff, restarted" else "never")
    standby = StandbyPolicy(wanted=moves == "handoff, standby" and kind != "job")
    return ProcessSpec(
        name, command=("run",), ros=kind == "node", priority=priority,
        kind=Kind.JOB if kind == "job" else Kind.SERVICE,
        needs={"memory": memory * MIB} if memory else {},
        required_labels={"arm": "yes"} if special else {},
        migration=migration or MigrationPolicy(), restart=restart, readiness=Readiness(timeout=4.0),
        lifecycle=LifecyclePolicy("active" if managed else "unmanaged", 1.0),
        standby=standby, reschedule=ReschedulePolicy(int(loss == "elsewhere"), 1.0),
        time_limit=6.0 if kind == "job" and memory == 100 else 0.0,
        host_loss=HostLossPolicy(loss, 1.0 if loss == "elsewhere" and memory else 0.0),
        devices=NEEDS[devices], array=ArrayMembership("r", 0, 2) if kind == "job" else NO_ARRAY,
        schedule=Schedule(every=4.0) if kind == "job" and memory == 300 else NO_SCHEDULE,
        start_order=start_order or StartOrder(), together="g" if related == "gang" else "",
        group=GROUPS[related],
    )  # fmt: skip


def after(name: str, start: str) -> StartOrder:
    """Return a start order after one process."""
    condition, _, more = start.partition(", ")
    on_restart = "restart" if more == "restart" else "ignore"
    return StartOrder({name: condition}, 1.0 if more == "later" else 0.0, on_restart)


def holds(state: MasterState, name: str, condition: str) -> bool:
    """Return True if a process meets the condition of a start order."""
    process = state.processes[name]
    if process.phase is ProcessPhase.FINISHED:
        return condition == "finished" or process.spec.kind is Kind.JOB
    return process.phase is ProcessPhase.RUNNING and condition == "ready"


class OneOther:
    """Checkpoint policy with one replica, on the same host as long as that is up."""

    def choose(self, view: CheckpointView) -> CheckpointChoice:
        there = [name for name in (*view.replica_hosts, *sorted(view.hosts)) if name in view.hosts]
        return CheckpointChoice(tuple(name for name in there if name != view.host)[:1])


class Play(RuleBasedStateMachine):
    """Rules of the state machine; its invariants are the guarantees of the core."""

    @initialize(
        backfill=chance, most=st.integers(1, 2), slots=st.integers(0, 2), first=ways, second=ways,
        loss=losses, preemption=st.sampled_from(["move", "requeue", False]), rebalance=chance,
        devices=asked,
    )  # fmt: skip
    def begin(
        self, backfill: bool, most: int, slots: int, first: str, second: str, loss: str,
        preemption: str | bool, rebalance: bool, devices: str,
    ) -> None:  # fmt: skip
        self.submitted: dict[str, float] = {}
        self.cluster = Cluster(
            backfill=backfill, max_migrations=most, settle=3.0, suspect=1.0, lease=5.0,
            delivery_timeout=2.0, cooldown=2.0, hysteresis=0.4, order_retry=1.0,
            preemption=preemption, rebalance=rebalance, rebalance_after=3.0, rebalance_spread=0.2,
            strategies={
                "relaunch": StartFirstOrStopFirst(timeout=3.0),
                "handoff": HandOver(timeout=3.0),
                "criu": Everywhere(seconds=1.0),
                "lifecycle_node": LifecycleNode(LifecycleNodeOptions()),
            },
        )  # fmt: skip
        self.cluster.checks = 0  # the state is checked after each rule
        self.cluster.state.replication.policy = OneOther()
        for name in HOSTS:
            labels = {"arm": "yes"} if name == LABELLED else {}
            machine = Portable(
                name, memory=1000 * MIB, cpu=4.0, labels=labels, devices=DEVICES[name],
                max_processes=slots if name == "b" else 0,
            )  # fmt: skip
            self.cluster.add(machine)
        #: Names whose newest process has ended by its own exit, with success or failure.
        self.completed: set[str] = set()
        self.failed: set[str] = set()
        #: Process and host where a start was impossible at some time.
        self.missing: set[tuple[str, str]] = set()
        #: Hosts on which each program ends soon after its start.
        self.broken: set[str] = set()
        self.late: list[happened.Event] = []
        self.left: set[int] = set()
        self.cluster.air.left = self.left
        #: Start of the contact with each host, without any lost or pending message.
        self.heard: dict[str, float] = {}
        self.records_seen = 0
        #: Snapshots that each host has reported to this run of the master, by name.
        self.reported: dict[str, tuple[SnapshotReport, ...]] = {}
        #: Hosts of the newest instance of each name, and of its shadows.
        self.ran_on: dict[str, set[str]] = {}
        #: For the present submission of each name: its first instance, and its newest snapshot.
        self.newest: dict[str, tuple[int, tuple[int, int]]] = {}
        self.prompt = True
        self.cluster.watch = self.look
        # Processes that run from the beginning.
        for name, moves in (("p0", first), ("p1", second)):
            self.cluster.submit(spec(name, "node", 100, moves, False, 0, loss, devices))
            for machine, running in self.programs():
                machine.seen_in_graph(running, self.cluster.now)
        self.cluster.settle()

    # --- execution -----------------------------------------------------------------------

    def tell(self, event: happened.Event) -> list[Command]:
        """Take one step of the core, whose commands `look` checks."""
        return self.cluster.tell(event)

    def ask(self, kind: type, *fields: object) -> bool:
        return self.cluster.ask(kind, *fields, settle=False).accepted

    def look(self, commands: Sequence[Command]) -> None:
        self.look_at_assignments(commands)
        self.look_at_time_limits(commands)
        self.note_given_up()

    def look_at_time_limits(self, commands: Sequence[Command]) -> None:
        """Check that no job is stopped for its time limit before it can have run so long."""
        for record in (command for command in commands if isinstance(command, Record)):
            if record.kind is EventKind.SUBMITTED:
                self.submitted[record.process] = self.cluster.now
            elif record.kind is EventKind.OVERDUE:
                limit = self.cluster.state.processes[record.process].spec.time_limit
                assert self.cluster.now - self.submitted[record.process] >= limit, record

    def look_at_assignments(self, commands: Sequence[Command]) -> None:
        state = self.cluster.state
        given = [command for command in commands if isinstance(command, Assign)]
        for assign in given:
            column = assign.host_id - 1
            over = state.hosts.busy[:, column] - state.hosts.limit[:, column]
            assert not (over > 1e-6).any(), "assigned over a limit"
            assert is_open(state.hosts, column), "assigned to a host that is closed"
            assert state.hosts.processes[column] <= state.hosts.bound[column]
            self.look_at_dependencies(assign)
        self.look_at_gangs(given)
        self.look_at_order(given)
        self.look_at_states(given)

    def look_at_dependencies(self, assign: Assign) -> None:
        """Check that no process starts before its dependencies hold."""
        state, order = self.cluster.state, assign.assignment.spec.start_order
        for name, condition in order.after.items():
            assert holds(state, name, condition), (name, condition)
            assert self.cluster.now >= state.processes[name].since + order.delay

    def look_at_states(self, given: list[Assign]) -> None:
        """Check that a process starts from the newest snapshot that is in reach or may return."""
        for assign in given:
            one = assign.assignment
            if not one.has_snapshots:
                continue
            instances = {
                name: snapshot.instance.number
                for name, snapshots in self.reported.items()
                for snapshot in snapshots
                if snapshot.instance.process == one.instance.process
                and snapshot.instance.number >= one.snapshots_from
            }
            keepers = {name for name in instances if self.known(self.machine(name))}
            keepers = {name for name in keepers if self.is_in_reach(self.machine(name))}
            assert keepers <= set(one.snapshot_hosts), "assigned without a known snapshot"
            ran_on = self.ran_on.get(one.instance.process, set())
            if not one.shadow and set(one.snapshot_hosts) <= keepers:
                newest = max((instances[name] for name in keepers), default=0)
                awaited = [name for name in instances.keys() - ran_on if self.may_return(name)]
                assert all(instances[name] <= newest for name in awaited), "not waited for"
        for assign in given:
            self.note_host(assign)

    def note_host(self, assign: Assign) -> None:
        """Note the host of the newest instance of a process, and those of its shadows."""
        name = assign.assignment.instance.process
        if not assign.assignment.shadow:
            self.ran_on.pop(name, None)
        host = self.cluster.state.hosts.hosts[assign.host_id - 1]
        self.ran_on.setdefault(name, set()).add(host.name)

    def may_return(self, name: str) -> bool:
        """Return True if a host was lost less than a lease ago."""
        state = self.cluster.state
        host = state.hosts.by_name[name]
        lost = state.hosts.condition_of(host) is HostCondition.LOST
        return lost and self.cluster.now < host.lost_since + state.settings.lease

    def look_at_order(self, given: list[Assign]) -> None:
        """Check that no process was passed by an equal one (without backfill: by any)."""
        state = self.cluster.state
        names = {assign.assignment.instance.process for assign in given}
        for name in names:
            chosen = state.processes[name]
            gang = [one for one in names if one in state.gangs.of(chosen)]
            place = min(self.place(one) for one in gang)
            for other in state.queue:
                waits = state.processes[other]
                if any(self.waits_for_no_room(one) for one in state.gangs.of(waits)):
                    continue
                if any(one in state.queue.awaiting for one in state.gangs.of(waits)):
                    continue
                ahead = min(self.place(one) for one in state.gangs.of(waits)) < place
                alike = demand_of(state, waits).key == demand_of(state, chosen).key
                alike = alike and len(gang) == len(state.gangs.of(waits)) == 1
                assert not (ahead and (alike or not state.settings.backfill)), "passed"

    def place(self, name: str) -> tuple[int, int]:
        process = self.cluster.state.processes[name]
        return -process.spec.priority, process.order

    def waits_for_no_room(self, name: str) -> bool:
        """Return True if a process waits for something else than room, and blocks no other."""
        state, queue = self.cluster.state, self.cluster.state.queue
        process = state.processes[name]
        delayed = awaits_states(state, process, self.cluster.now) or name in queue.delayed
        return delayed or name not in queue

    def look_at_gangs(self, given: list[Assign]) -> None:
        """Check that each gang of which a process was assigned was assigned as a whole."""
        state = self.cluster.state
        names = {assign.assignment.instance.process for assign in given}
        for name in names:
            process = state.processes[name]
            if process.awaits_gang:
                assert names.issuperset(state.gangs.of(process)), "a part of a gang was assigned"

    def machine(self, name: str) -> Machine:
        return self.cluster.machines[name]

    def register(self, machine: Machine) -> None:
        if not machine.connected:
            return
        snapshots = tuple(machine.snapshots.values())
        before, self.reported[machine.name] = self.reported.get(machine.name, ()), snapshots
        if not self.cluster.enter(machine, 0, snapshots).accepted:
            self.reported[machine.name] = before

    def pick(self, things: list, which: int) -> object:
        return things[which % len(things)]

    def movable(self) -> list[str]:
        """Return the processes that run and have a strategy."""
        return [
            process.name
            for process in self.cluster.state.processes.values()
            if process.phase is ProcessPhase.RUNNING and process.spec.migration.strategy
        ]

    def programs(self) -> list[tuple[Machine, str]]:
        """Return each process that really runs, with its machine."""
        return [
            (machine, instance.process)
            for machine in self.cluster.machines.values()
            for instance in machine.programs
        ]

    def with_orders(self) -> list[Machine]:
        return [one for one in self.cluster.machines.values() if one.ordered and one.connected]

    def with_statuses(self) -> list[Machine]:
        return [
            one for one in self.cluster.machines.values() if one.status_batches and one.connected
        ]

    def flow(self) -> None:
        """Deliver all messages at once while the network is prompt."""
        if self.prompt:
            self.everything_arrives()

    def known(self, machine: Machine) -> bool:
        """Return True if the master knows this run of the slave."""
        find = self.cluster.state.hosts.find
        return machine.connected and find(machine.host_id, machine.incarnation) is not None

    # --- users ---------------------------------------------------------------------------

    @rule(
        name=names, kind=kinds,
        memory=st.sampled_from([0, 100, 100, 300]),
        moves=ways | st.just(""),
        special=chance, urgent=chance, twin=names, loss=losses, devices=asked,
        related=st.sampled_from(list(GROUPS)),
    )  # fmt: skip
    def submit(
        self, name: str, kind: str, memory: int, moves: str, special: bool, urgent: bool,
        twin: str, loss: str = "wait", devices: str = "", related: str = "",
    ) -> None:  # fmt: skip
        special = special and memory == 300
        specs = [
            spec(one, kind, memory, moves, special, int(urgent), loss, devices, related=related)
            for one in (name, twin)
        ]
        self.submit_all(specs)

    @rule(name=names, then=names, start=starts, more=starts, kind=kinds, loss=losses, moves=ways)
    def submit_in_order(
        self, name: str, then: str, start: str, more: str, kind: str, loss: str, moves: str
    ) -> None:
        """Submit a process that starts after a live or a new one, and one that starts after it."""
        known = self.cluster.state.processes.get(name)
        first = [spec(name, "job" if "finished" in start else kind, 0, "", False, 0, loss)]
        second = spec(f"{name}x", kind, 100, moves, False, 1, loss, "", after(name, start))
        order = after(second.name, more)
        third = [spec(f"{then}x", kind, 0, "", False, 0, loss, "", order)] if then != name else []
        lives = known is not None and not known.phase.is_terminal
        self.submit_all([*([] if lives else first), second, *third])

    def submit_all(self, specs: list[ProcessSpec]) -> None:
        before = set(self.cluster.state.processes)
        if self.ask(happened.SubmissionReceived, tuple(specs)):
            for one in specs:
                self.completed.discard(one.name)
                self.failed.discard(one.name)
        else:
            assert set(self.cluster.state.processes) == before
        self.flow()

    @rule(name=names)
    def cancel(self, name: str) -> None:
        self.ask(happened.CancelRequested, (name,))
        self.flow()

    @rule()
    def cancel_all(self) -> None:
        """Cancel all at once, in the reverse order of their starts."""
        self.ask(happened.CancelRequested, tuple(self.cluster.state.processes))
        self.flow()

    @rule(name=names)
    def restart(self, name: str) -> None:
        process = self.cluster.state.processes.get(name)
        ended = process is not None and process.phase.is_terminal
        if self.ask(happened.RestartRequested, (name,)) and ended:
            self.completed.discard(name)
            self.failed.discard(name)
        self.flow()

    @precondition(lambda self: self.cluster.state.start_orders.dependants)
    @rule(which=which_one)
    def restart_a_dependency(self, which: int) -> None:
        self.restart(self.pick(list(self.cluster.state.start_orders.dependants), which))

    @precondition(lambda self: self.movable())
    @rule(which=which_one, seconds=st.sampled_from([1.0, 2.5, 3.5, 7.0]))
    def migrate_what_does_not_stop(self, which: int, seconds: float) -> None:
        name = self.pick(self.movable(), which)
        for machine, running in self.programs():
            if running == name:
                machine.stubborn.add(name)
        self.ask(happened.MigrationRequested, name, None)
        self.flow()
        self.time_passes(seconds, quiet=False)

    @rule(name=names, seconds=st.sampled_from([1.0, 2.5, 3.5]))
    def submit_and_lose_the_answer_to_the_poll(self, name: str, seconds: float) -> None:
        self.prompt = False
        self.submit(name, "service", 100, "", special=False, urgent=False, twin=f"{name}x")
        for machine in self.cluster.machines.values():
            machine.polled.clear()
        self.time_passes(seconds, quiet=False)

    @precondition(lambda self: self.movable())
    @rule(which=which_one, host=st.none() | hosts)
    def migrate(self, which: int, host: str | None) -> None:
        self.ask(happened.MigrationRequested, self.pick(self.movable(), which), host)
        self.flow()

    @rule()
    def prune(self) -> None:
        self.ask(happened.PruneRequested)
        self.flow()

    @rule(host=hosts, action=st.sampled_from(["cordon", "uncordon", "uncordon", "drain"]))
    def set_host(self, host: str, action: str) -> None:
        self.ask(happened.HostStateRequested, host, action)
        self.flow()

    # --- nodes ---------------------------------------------------------------------------

    def nodes(self, *strategies: str) -> list[tuple[Machine, Node]]:
        """Return nodes of processes that move by these strategies; default: all with state."""
        return [
            (machine, node)
            for machine, node in self.cluster.air.nodes()
            if machine.programs[node.instance].assignment.spec.migration.strategy
            in (strategies or ("handoff",))
        ]

    @precondition(lambda self: self.nodes())
    @rule(which=which_one, what=st.sampled_from([*QUIRKS, "none"]))
    def node_changes(self, which: int, what: str) -> None:
        """Change a node's violation of the protocol, or remove it."""
        _, node = self.pick(self.nodes(), which)
        node.quirks.clear()
        if what != "none":
            node.quirks.add(what)
        self.flow()

    @precondition(lambda self: self.cluster.air.waiting())
    @rule(which=which_one)
    def node_hears_something(self, which: int) -> None:
        self.pick(self.cluster.air.waiting(), which)()
        self.flow()

    @precondition(lambda self: self.cluster.air.next_reports())
    @rule(which=which_one)
    def report_arrives(self, which: int) -> None:
        at = self.pick(self.cluster.air.next_reports(), which)
        self.tell(self.cluster.air.to_master.pop(at)[1])
        self.flow()

    @precondition(lambda self: self.nodes())
    @rule(which=which_one, of_another=chance)
    def source_asks_if_it_may_resume(self, which: int, of_another: bool) -> None:
        """Any node may ask at any time, with the number of its handoff or of another one.

        `Node.wake` checks that no other node is active.
        """
        machine, node = self.pick(self.nodes(), which)
        if machine.connected:
            destination = 10**6 if of_another else node.handoff
            self.tell(happened.SourceStranded(node.instance.number, destination))
        self.flow()

    @precondition(lambda self: self.nodes())
    @rule(
        which=which_one, until=st.sampled_from(["SHADOW", "SWITCH", "SILENT", "ACTIVE"]),
        fate=st.sampled_from(["", "source ends", "destination ends", "master is killed"]),
        seconds=st.sampled_from([0.0, 0.0, 4.0, 7.0]),
        quirk=st.sampled_from(["", "", "", "never silent", "no abort", "no resume"]),
    )  # fmt: skip
    def migrate_with_state(
        self, which: int, until: str, fate: str, seconds: float, quirk: str
    ) -> None:
        """Run a handoff until a message was published, and then inject a fault."""
        _, node = self.pick(self.nodes(), which)
        name = node.instance.process
        for machine in self.cluster.machines.values():
            machine.quirks[name] |= {quirk} - {""}
        self.ask(happened.MigrationRequested, name, None)
        self.prompt = False
        self.go_on_until(name, until)
        ours = [one for one in self.nodes() if one[1].instance.process == name]
        if fate == "master is killed":
            self.master_is_killed(HOSTS)
        elif fate and ours:
            pick = min if fate == "source ends" else max
            machine, node = pick(ours, key=lambda one: one[1].instance.number)
            machine._end(node.instance, InstanceState.FAILED, self.cluster.now, code=3)
            self.failed.add(name)
        if seconds:
            self.time_passes(seconds, quiet=False)

    def go_on_until(self, name: str, word: str) -> None:
        """Deliver messages until one was published; from SWITCH on none reaches the master."""
        for _ in range(40):
            phases = {one.phase.name for one in self.cluster.air.latched if one.process == name}
            said = {
                report.phase.name
                for _, node in self.nodes()
                if node.instance.process == name
                for report in node.sent
            }
            if word in phases | said:
                return
            if "SWITCH" not in phases:
                self.everything_arrives(nodes=False)
            self.cluster.nodes_talk(heard="SWITCH" not in phases)

    # --- the network ---------------------------------------------------------------------

    @rule(host=hosts)
    def slave_fetches(self, host: str) -> None:
        machine = self.machine(host)
        if machine.connected:
            machine.fetch(self.cluster.now)

    @precondition(lambda self: self.with_orders())
    @rule(at=which_one, which=which_one, fate=st.sampled_from(["", "", "", "lost", "twice"]))
    def order_arrives(self, at: int, which: int, fate: str) -> None:
        machine = self.pick(self.with_orders(), at)
        which %= len(machine.ordered)
        order = machine.ordered[which]
        if fate != "twice":
            del machine.ordered[which]
        if fate == "lost":
            self.heard.pop(machine.name, None)
            self.tell(happened.OrderAnswered(order.order_id, accepted=False, code="timeout"))
        else:
            self.tell(machine.obey(order, self.cluster.now))
        self.flow()

    @precondition(lambda self: self.with_statuses())
    @rule(
        at=which_one, which=st.sampled_from([0, 0, 0, 1, 2]),
        fate=st.sampled_from(["", "", "", "lost", "twice"]),
    )  # fmt: skip
    def statuses_arrive(self, at: int, which: int, fate: str) -> None:
        machine = self.pick(self.with_statuses(), at)
        which %= len(machine.status_batches)
        batch = machine.status_batches[which]
        del machine.status_batches[which]
        if fate == "twice":
            self.late.append(batch)
        if fate != "lost":
            self.tell(batch)
        else:
            self.heard.pop(machine.name, None)
        self.flow()

    @rule(host=hosts, keep=chance)
    def reading_arrives(self, host: str, keep: bool) -> None:
        machine = self.machine(host)
        if self.known(machine):
            readings = self.cluster.readings([machine])
            if keep:
                self.late.append(readings)
            else:
                self.tell(readings)
                self.tell(machine.usages(self.cluster.now))
        self.flow()

    @precondition(lambda self: self.late)
    @rule(which=which_one)
    def something_arrives_late(self, which: int) -> None:
        """Deliver a reading that was overtaken, or a status batch a second time."""
        self.tell(self.late.pop(which % len(self.late)))

    @rule(host=hosts)
    def everything_is_asked_for(self, host: str) -> None:
        """Request a full report, which arrives now and perhaps again later."""
        machine = self.machine(host)
        if self.known(machine):
            machine.tell(events.ReportRequested(), self.cluster.now)
            self.late.append(machine.status_batches[-1])

    @rule(prompt=chance)
    def network_is(self, prompt: bool) -> None:
        self.prompt = prompt
        self.flow()

    # --- machines and processes ----------------------------------------------------------

    @precondition(lambda self: self.programs())
    @rule(which=which_one, code=st.sampled_from([0, 0, 3]), run_time=st.sampled_from([0.1, 9.0]))
    def process_ends(self, which: int, code: int, run_time: float) -> None:
        machine, name = self.pick(self.programs(), which)
        machine.finish(name, self.cluster.now, code=code, run_time=run_time)
        (self.failed if code else self.completed).add(name)
        self.flow()

    @precondition(lambda self: self.programs())
    @rule(which=which_one)
    def node_is_seen(self, which: int) -> None:
        machine, name = self.pick(self.programs(), which)
        machine.seen_in_graph(name, self.cluster.now)
        self.flow()

    @rule(
        which=which_one, host=hosts, name=names,
        what=st.sampled_from(["stubborn", "tame", "missing", "there", "large", "small"]),
    )  # fmt: skip
    def program_changes(self, which: int, host: str, name: str, what: str) -> None:
        """Change a program: signals ignored, executable missing, or usage."""
        machine = self.machine(host)
        if self.programs() and what != "missing":
            machine, name = self.pick(self.programs(), which)
        if what == "stubborn":
            machine.stubborn.add(name)
        elif what == "tame":
            self.tame(machine, {name})
        elif what == "missing":
            machine.refuses[name] = "no such executable"
            self.missing.add((name, machine.name))
        elif what == "there":
            machine.refuses.pop(name, None)
        else:
            memory = 400.0 if what == "large" else 50.0
            machine.shown[name] = {"memory": memory * MIB, "cpu": 0.1}
        self.flow()

    def tame(self, machine: Machine, names: set[str]) -> None:
        machine.stubborn -= names
        for instance in list(machine.programs):
            stopping = machine.programs[instance].state.value == "stopping"
            if stopping and instance.process in names:
                machine._stop(instance, self.cluster.now)

    @rule(host=hosts, what=st.sampled_from(HOST_CHANGES))
    def host_changes(self, host: str, what: str) -> None:
        """Change a host: its wire, its slave, or its load by others."""
        machine = self.machine(host)
        if what in ("cut", "mended"):
            machine.connected = what == "mended"
        elif what == "killed":
            machine.restart_slave(self.cluster.now)
            self.register(machine)
        elif what == "leaves" and self.known(machine):
            machine.leaves = True
            self.ask(happened.HostLeft, machine.host_id, machine.incarnation)
            for instance in list(machine.programs):
                machine.tell(events.StopOrdered(instance), self.cluster.now)
        elif what == "is detached" and self.known(machine):
            # No slave runs until it is killed or `all_is_well`.
            self.ask(happened.HostLeft, machine.host_id, machine.incarnation, machine.begun())
            machine.restart_slave(self.cluster.now)
        elif what in ("stops unreachable", "loses power"):
            if what == "stops unreachable":
                machine.stop_unreachable(self.cluster.now)
            else:
                self.lose_power(machine)
            machine.restart_slave(self.cluster.now)
            self.register(machine)
        elif what == "another supervisor":
            machine.replace_supervisor(self.cluster.now)
        elif what == "loses a poll":
            machine.polled.clear()
        elif what in ("breaks", "works"):
            self.broken = {*self.broken, host} if what == "breaks" else self.broken - {host}
        elif what in ("full", "over", "empty"):
            machine.busy["memory"] = {"full": 0.75, "over": 0.85, "empty": 0.1}[what]
        self.flow()

    def lose_power(self, machine: Machine) -> None:
        """End everything on the host; restart policies start processes again after the rejoin."""
        self.end_all(machine, code=-1)

    def end_all(self, machine: Machine, code: int) -> None:
        for instance in list(machine.programs):
            if machine.programs[instance].restart.when == "never":
                self.failed.add(instance.process)
            machine.finish(instance.process, self.cluster.now, code=code)

    @rule(host=hosts, which=which_one)
    def device_goes_or_returns(self, host: str, which: int) -> None:
        """Take away a device of a host, or bring it back; its slave reports that if it can."""
        machine = self.machine(host)
        chosen = self.pick(machine.devices, which)
        changed = replace(chosen, missing="" if chosen.missing else "gone")
        machine.devices = tuple(changed if one is chosen else one for one in machine.devices)
        if self.known(machine):
            machine.report_devices()
        self.flow()

    @rule()
    def all_is_well(self) -> None:
        """Connect and open every host and let it request work."""
        for machine in self.cluster.machines.values():
            machine.connected = True
            machine.busy["memory"] = 0.1
            if not self.known(machine) or not self.is_up(machine):
                machine.restart_slave(self.cluster.now)
                self.cluster.now += 1.5
                self.tell(happened.TimePassed())
                self.register(machine)
            self.ask(happened.HostStateRequested, machine.name, "uncordon")
        self.time_passes(0.05, quiet=False)

    def is_up(self, machine: Machine) -> bool:
        return self.condition(machine) == "UP"

    def is_in_reach(self, machine: Machine) -> bool:
        return self.condition(machine) in ("UP", "SUSPECT")

    def condition(self, machine: Machine) -> str:
        """Return the condition of a host in the state of the master."""
        table = self.cluster.state.hosts
        return table.condition_of(table.by_name[machine.name]).name

    # --- time and the master -------------------------------------------------------------

    @rule(seconds=st.sampled_from([-2e9, -3600.0, 5.0, 3600.0, 2e9]))
    def set_the_clock(self, seconds: float) -> None:
        """Set the wall clock of the master's machine; all durations stay as they are."""
        self.cluster.clock_set_by += seconds
        self.cluster.state.wall = self.cluster.wall

    @rule(seconds=st.sampled_from([0.05, 0.3, 0.3, 1.0, 2.5, 6.0]), quiet=chance)
    def time_passes(self, seconds: float, quiet: bool) -> None:
        self.cluster.now += seconds
        for machine in self.cluster.machines.values():
            machine.tell(events.TimePassed(), self.cluster.now)
            if self.known(machine) and not quiet:
                self.tell(self.cluster.readings([machine]))
                self.tell(machine.usages(self.cluster.now))
                self.cluster.ask_for_work(machine)
        self.tell(happened.TimePassed())
        self.flow()

    @precondition(lambda self: not self.prompt)
    @rule()
    def all_arrives(self) -> None:
        self.everything_arrives()

    def everything_arrives(self, *, nodes: bool = True) -> None:
        for _ in range(3):
            while nodes and self.cluster.nodes_talk():
                pass
            for machine in self.cluster.machines.values():
                self.cluster.deliver(machine)
                if machine.name in self.broken:
                    self.end_all(machine, code=1)

    @rule(registering=st.lists(hosts, unique=True, max_size=3))
    def master_is_killed(self, registering: list[str]) -> None:
        """Kill the master, restore it from its journal and register some slaves."""
        self.late.clear()
        self.reported.clear()
        self.cluster.kill_master()
        self.cluster.state.replication.policy = OneOther()
        for host in registering:
            self.register(self.machine(host))

    # --- snapshots -----------------------------------------------------------------------

    @precondition(lambda self: self.nodes())
    @rule(which=which_one, told=chance)
    def snapshot_is_published(self, which: int, told: bool) -> None:
        """Publish a snapshot on the node's host; its slave sends replicas if ordered to."""
        self.publish_snapshot(*self.pick(self.nodes(), which), told=told)
        self.flow()

    def publish_snapshot(self, machine: Machine, node: Node, *, told: bool) -> None:
        if node.shadow or not node.active:
            return
        state = machine.publish_snapshot(node.instance)
        for name in machine.ships.get(node.instance.process, ()):
            if machine.connected and self.machine(name).connected:
                self.machine(name).take_state(state)
        if told:
            for one in self.cluster.machines.values():
                self.report_snapshots(one)

    @precondition(lambda self: self.nodes())
    @rule(which=which_one, comes_back=chance, stubborn=chance)
    def host_is_lost_with_a_state(self, which: int, comes_back: bool, stubborn: bool) -> None:
        """Cut off the host of a process, which then continues from a replica elsewhere."""
        machine, node = self.pick(self.nodes(), which)
        self.all_is_well()
        self.time_passes(1.0, quiet=False)
        if node.instance not in machine.programs:
            return
        if stubborn:
            machine.stubborn.add(node.instance.process)
        self.publish_snapshot(machine, node, told=True)
        self.time_passes(1.0, quiet=False)  # the slave receives the hosts of the next replica
        if node.instance in machine.programs:
            self.publish_snapshot(machine, node, told=True)
        machine.connected = False
        for _ in range(4):
            self.time_passes(2.5, quiet=False)
        if comes_back:
            machine.connected = True
            for _ in range(4):
                self.time_passes(0.5, quiet=False)

    @precondition(lambda self: self.nodes())
    @rule(which=which_one)
    def hosts_of_a_successor_are_lost(self, which: int) -> None:
        """Cut off a host until its process has a successor elsewhere; then all other hosts."""
        former, node = self.pick(self.nodes(), which)
        self.host_is_lost_with_a_state(which, comes_back=False, stubborn=False)
        for machine, name in self.programs():
            if name == node.instance.process and machine is not former:
                machine.seen_in_graph(name, self.cluster.now)
        for _ in range(2):
            self.time_passes(1.0, quiet=False)  # its replica gets a host
        for machine, other in self.nodes():
            if other.instance.process == node.instance.process and machine is not former:
                self.publish_snapshot(machine, other, told=True)
        for machine in self.cluster.machines.values():
            machine.connected = machine is former
        for _ in range(4):
            self.time_passes(2.5, quiet=False)

    @rule(host=hosts)
    def snapshots_are_reported(self, host: str) -> None:
        self.report_snapshots(self.machine(host))
        self.flow()

    def report_snapshots(self, machine: Machine) -> None:
        if self.known(machine):
            snapshots = tuple(machine.snapshots.values())
            self.reported[machine.name] = snapshots
            self.tell(happened.SnapshotsReported(machine.host_id, machine.incarnation, snapshots))

    @rule(name=names, durable=chance)
    def master_is_killed_in_the_act(self, name: str, durable: bool) -> None:
        """Kill the master after a decision, before or after the write to the journal."""
        one = spec(name, "service", 100, "", False, 0)
        commands = self.cluster.decide(happened.SubmissionReceived(0, (one,)))
        if durable:
            self.cluster.journal(commands)
            if any(isinstance(command, Assign) for command in commands):
                self.completed.discard(name)
                self.failed.discard(name)
        self.master_is_killed([])

    # --- invariants ----------------------------------------------------------------------

    @invariant()
    def the_state_is_sound(self) -> None:
        check(self.cluster.state)

    @invariant()
    def no_device_is_given_twice(self) -> None:
        """Check the units of all processes that really run, on lost hosts and in moves, too."""
        for machine in self.cluster.machines.values():
            shares: dict[tuple[str, str], float] = defaultdict(float)
            for program in machine.programs.values():
                for held in program.assignment.devices:
                    shares[held.kind, held.unit] += held.share
                asked = program.assignment.spec.devices
                assert bool(asked) == bool(program.assignment.devices)
            assert all(share < 1.0 + 1e-9 for share in shares.values()), (machine.name, shares)

    def given_up(self) -> set[int]:
        """Return instances that may run on lost hosts, unaware of their successors.

        An instance is removed shortly after its host rejoins.
        """
        self.note_given_up()
        for machine in self.cluster.machines.values():
            if self.is_heard_well(machine):
                self.left -= {instance.number for instance in machine.programs}
        return self.left

    def note_given_up(self) -> None:
        for record in self.cluster.records[self.records_seen :]:
            if record.kind == "given_up":
                self.left.add(record.facts["number"])
            elif record.kind == "readopted":
                self.left.discard(record.facts["number"])
        self.records_seen = len(self.cluster.records)

    @invariant()
    def each_restart_is_carried_out_at_most_once(self) -> None:
        """Orders that are lost, late or repeated restart no other run than the one they mean."""
        kinds = (EventKind.RESTART_REQUESTED, EventKind.DEPENDENCY_RESTARTED)
        begun = Counter(one.process for one in self.cluster.records if one.kind in kinds)
        for machine in self.cluster.machines.values():
            begun.subtract(machine.ordered_restarts)
        assert min(begun.values(), default=0) >= 0, begun

    def is_heard_well(self, machine: Machine) -> bool:
        """Return True if the contact was long enough to report all instances there."""
        calm = self.known(machine) and self.is_up(machine)
        if not calm or machine.ordered or machine.status_batches or machine.polled:
            self.heard.pop(machine.name, None)
            return False
        return self.cluster.now - self.heard.setdefault(machine.name, self.cluster.now) >= (
            FENCED_WITHIN
        )

    @invariant()
    def never_two_active(self) -> None:
        """Check that one instance of a process really runs; two only with a declared overlap."""
        left = self.given_up()
        for name in (*NAMES, *TWINS):
            running = [
                program.assignment
                for machine in self.cluster.machines.values()
                for program in machine.programs.values()
                if program.assignment.instance.process == name
                and program.assignment.instance.number not in left
            ]
            overlap = all(one.spec.migration.overlap and one.spec.migration.strategy
                          for one in running)  # fmt: skip
            strategies = {one.spec.migration.strategy for one in running}
            # All but one node are silent, see below.
            silent = strategies in ({"handoff"}, {"criu"}, {"lifecycle_node"})
            most = 2 if overlap or silent else 1
            most += any(one.spec.standby.wanted for one in running)
            assert len(running) <= most, [str(one.instance) for one in running]
        moved = self.nodes("handoff", "criu")
        for name in {node.instance.process for _, node in moved}:
            active = [
                node for _, node in moved
                if node.instance.process == name and node.instance.number not in left
            ]  # fmt: skip
            assert sum(node.active for node in active) <= 1, [str(one.instance) for one in active]
        managed = Counter(
            instance.process
            for machine in self.cluster.machines.values()
            for instance, program in machine.programs.items()
            if program.assignment.spec.lifecycle.is_managed
            and program.lifecycle_state == "active" and instance.number not in left
        )  # fmt: skip
        assert not [name for name, active in managed.items() if active > 1]

    @invariant()
    def what_was_cancelled_runs_nowhere(self) -> None:
        """Check that a `cancelled` process has really ended, or that a fence will end it."""
        left = self.given_up()
        for process in self.cluster.state.processes.values():
            if process.phase is not ProcessPhase.CANCELLED or process.spec.host_loss.then != "wait":
                continue
            running = {
                instance.number
                for machine in self.cluster.machines.values()
                for instance in machine.programs
                if instance.process == process.name and instance.number >= process.born
            }
            assert running <= left | process.instances, process.name

    @invariant()
    def the_newest_state_of_a_life_is_not_dropped(self) -> None:
        """Check that the newest snapshot of a process exists until it finished or was cancelled."""
        for process in self.cluster.state.processes.values():
            name, born = process.name, process.born
            before = self.newest.pop(name, (born, (0, 0)))
            if process.phase.is_terminal or process.wanted is DesiredState.CANCEL:
                continue
            ages = [
                (one.instance.number, one.sequence)
                for machine in self.cluster.machines.values()
                if (one := machine.snapshots.get(name)) is not None and one.instance.number >= born
            ]
            newest = max(ages, default=(0, 0))
            if before[0] == born:
                assert newest >= before[1], (name, before, newest)
            self.newest[name] = (born, newest)

    @invariant()
    def what_waits_for_others_can_be_found(self) -> None:
        """Check the index of start orders against the specs."""
        state = self.cluster.state
        orders = {
            process.name: process.spec.start_order
            for process in state.processes.values()
            if process.spec.start_order.after and not process.phase.is_terminal
        }
        assert state.start_orders.declared == orders
        assert {
            (name, one) for name, found in state.start_orders.dependants.items() for one in found
        } == {(name, one) for one, order in orders.items() for name in order.after}
        assert state.queue.awaiting <= orders.keys() | state.strays.keys()
        for name in state.start_orders.last_to_stop:
            assert state.processes[name].wanted is DesiredState.CANCEL

    @invariant()
    def an_end_is_told_as_it_was(self) -> None:
        """Check that each finished or failed process really ended so."""
        for process in self.cluster.state.processes.values():
            if process.phase is ProcessPhase.FINISHED:
                assert process.name in self.completed
            for host in process.excluded:
                assert (process.name, host) in self.missing
            assert len(process.failed_on) <= process.reschedules
            if process.phase is ProcessPhase.FAILED and not process.spec.ros:
                missing = {name for name, _ in self.missing}
                host_lost = process.spec.host_loss.then == "stop"
                assert host_lost or process.overdue or process.name in self.failed | missing

    def teardown(self) -> None:
        """Check that all processes reach their end once all faults are repaired."""
        if not hasattr(self, "cluster"):
            return
        cluster = self.cluster
        self.broken.clear()
        for machine in cluster.machines.values():
            machine.connected = True
            machine.refuses.clear()
            machine.shown.clear()
            for quirks in machine.quirks.values():
                quirks.clear()
            machine.busy["memory"] = 0.05
            machine.devices = DEVICES[machine.name]
            self.tame(machine, {*NAMES, *TWINS})
            machine.restart_slave(cluster.now)
        cluster.now += 2.0
        cluster.tell(happened.TimePassed())
        for machine in cluster.machines.values():
            cluster.register(machine, tuple(machine.snapshots.values()))
        for name in HOSTS:
            cluster.set_host(name, "uncordon")
        self._let_nodes_come_up(40)
        assert not cluster.state.reports_awaited
        assert not [one for one in cluster.state.instances.values() if one.restarting]
        calm = {"queued", "set_aside", "running", "finished", "failed", "cancelled"}
        for process in cluster.state.processes.values():
            assert process.phase.value in calm, (process.name, process.phase, process.reason)
            where = cluster.where(process.name)
            if process.name in cluster.state.standbys:
                where.remove(cluster.state.standbys[process.name].destination_host.name)
            assert len(where) == (process.phase is ProcessPhase.RUNNING), (process.name, where)
            assert cluster.active(process.name) == where
            if process.phase is ProcessPhase.RUNNING and process.restart_due:
                conditions = process.spec.start_order.after.items()
                assert not all(holds(cluster.state, *one) for one in conditions), process.name
        self._cancel_all()

    def _let_nodes_come_up(self, times: int) -> None:
        for _ in range(times):
            for machine in self.cluster.machines.values():
                for instance in list(machine.programs):
                    machine.tell(events.SeenInGraph(instance), self.cluster.now)
            self.cluster.wait(1.0, tick=0.5)
            self.the_state_is_sound()
            self.never_two_active()
            self.the_newest_state_of_a_life_is_not_dropped()

    def _cancel_all(self) -> None:
        cluster = self.cluster
        live = [p.name for p in cluster.state.processes.values() if not p.phase.is_terminal]
        if live:
            assert cluster.cancel(*live).accepted
        cluster.wait(5.0, tick=0.5)
        assert all(process.phase.is_terminal for process in cluster.state.processes.values())
        assert not any(machine.programs for machine in cluster.machines.values())
        assert not cluster.state.instances
        assert not cluster.state.migrations
        assert not cluster.state.standbys
        assert not len(cluster.state.queue)
        assert np.allclose(cluster.state.hosts.load, 0.0, atol=1e-6)
        for host in cluster.state.hosts.hosts:
            inventory = cluster.state.hosts.devices[host.column]
            assert inventory.devices == DEVICES[host.name]
            assert not inventory.held
        assert not cluster.intents["migration"]
        self._every_order_ends()

    def _every_order_ends(self) -> None:
        """Check that no order waits for its answer for ever, whatever was lost."""
        orders, now = self.cluster.state.pending_orders, self.cluster.now
        orders.expired(now)
        assert set(orders.expired(now + 3600.0)) == orders.pending.keys()


TestPlay = pytest.mark.timeout(300)(Play.TestCase)  # 60 s alone, more beside other work


def test_a_source_that_was_given_up_owns_no_name_after_its_move_is_undone() -> None:
    """The source returned with its host during the undo, and was being stopped: it owns nothing."""
    play = Play()
    play.begin(
        backfill=False, most=1, slots=0, first="handoff, standby", second="handoff, standby",
        loss="wait", preemption="move", rebalance=False, devices="",
    )  # fmt: skip
    for which in (3, 0):
        play.hosts_of_a_successor_are_lost(which=which)
        play.all_is_well()
        play.the_state_is_sound()
    play.teardown()
