"""Simulated cluster with the cores of master, slaves and supervisors, and messages that take time.

The messages between master and slaves have numbers, and one of them meets a fault, its fate. The
nodes of a handoff talk without delay. After each event `ThreeCores.check_processes` looks at the
processes that really run.
"""

from __future__ import annotations

import heapq
import signal
from collections import defaultdict
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import partial
from itertools import count
from typing import Any, Final, Literal, NamedTuple, get_args

from rosrm.core.master import events as happened
from rosrm.core.master.commands import Assign, SendOrder
from rosrm.core.master.state.process import Instance as MasterInstance
from rosrm.core.slave import commands, events
from rosrm.core.slave.orders import event_of, why_stale
from rosrm.core.slave.state import SlaveState
from rosrm.core.slave.watches import Memo
from rosrm.core.supervisor import commands as acts
from rosrm.core.supervisor import events as told
from rosrm.core.supervisor.instance import STARTING, UNKNOWN_EXIT, Instance
from rosrm.core.supervisor.reducer import SupervisorState
from rosrm.core.supervisor.rules import RestartRule
from rosrm.model.orders import AmendInstance, SetLifecycleState, seconds_of
from rosrm.model.values import (
    Assignment,
    InstanceId,
    InstanceState,
    InstanceStatus,
    Kind,
    RestartPolicy,
)
from rosrm.slave.supervisor_client import _order_of
from rosrm.supervisor import messages
from rosrm.supervisor.client_values import fence_rule, key_of, restart_rule, stop_rule
from rosrm_migration.lifecycle_node import LifecycleNode, LifecycleNodeOptions
from tests.unit.core.cluster import Cluster
from tests.unit.core.machine import Program
from tests.unit.core.portable import Portable, by_criu

#: Fault at one message: it is lost, arrives late, or a second time; the slave or the supervisor of
#: its host is killed after it; the master is killed before or after it; its host is cut off from
#: then on; or all hosts with processes are cut off, after it and until their leases have expired.
Fate = Literal[
    "lost", "late", "twice", "slave killed", "supervisor killed", "master killed before",
    "master killed after", "host cut", "busy hosts cut",
]  # fmt: skip
FATES: Final[tuple[Fate, ...]] = get_args(Fate)
#: Fate of a message by its number and description; "": it arrives.
FateOf = Callable[[int, str], Fate | Literal[""]]

#: Seconds of a message between master and slave, also of a late one, and within a host.
LATENCY: Final = 0.02
LATE: Final = 4.0
MOMENT: Final = 0.005
#: Seconds for which a host is cut off, and until a part that was killed runs again.
CUT: Final = 3.0
LONG_CUT: Final = 14.0
SLAVE_DOWN, SUPERVISOR_DOWN, MASTER_DOWN = 0.7, 0.3, 0.5
#: Seconds after which the master gives up an answer, beyond those that the order may take.
ORDER_TIMEOUT: Final = 3.0


def _arrives(_number: int, _message: str) -> Literal[""]:
    return ""


class Launch(NamedTuple):
    """Order to start an instance, with the facts that the supervisor keeps for the slave."""

    order: told.StartOrdered
    assignment: Assignment
    memo: Memo


@dataclass
class TimedHost(Portable):
    """Simulated host with the core of its supervisor; starts, ends and messages take time.

    A command of the form `(version, seconds, exit code)` ends after these seconds; others run on.

    Attributes:
        cluster: has the clock and the wire.
        supervisor: also the record that the next supervisor restores.
        slave_run, supervisor_run: number of the kills of each; nothing for a former run arrives.
        launches: orders that no supervisor has acknowledged.
        launched: those of the supervisor's instances.
        spawning: instances whose start the supervisor has begun.
        unsettled: calls for the answers to orders that the supervisor or a node completes.
    """

    cluster: ThreeCores = field(kw_only=True, repr=False)
    supervisor: SupervisorState = field(default_factory=SupervisorState)
    slave_lives: bool = True
    supervisor_lives: bool = True
    slave_run: int = 0
    supervisor_run: int = 0
    launches: dict[InstanceId, Launch] = field(default_factory=dict)
    launched: dict[InstanceId, Launch] = field(default_factory=dict)
    spawning: set[InstanceId] = field(default_factory=set)
    unsettled: dict[Any, list[Callable[[str, str], None]]] = field(
        default_factory=lambda: defaultdict(list)
    )

    # --- the slave -----------------------------------------------------------------------

    def tell(self, event: events.Event, now: float) -> None:
        if self.slave_lives:
            super().tell(event, now)

    def say(self, batch: happened.StatusesReceived) -> None:
        if self.host_id:
            told_of = ", ".join(f"{one.instance} {one.state.value}" for one in batch.statuses)
            self.cluster.link(self, f"status {told_of}", partial(self.cluster.tell, batch))

    def receive(self, sent: SendOrder, respond: Callable[[happened.OrderAnswered], None]) -> None:
        """Receive an order of the master, and answer once it is carried out."""
        order, now = sent.order, self.cluster.now
        stale = why_stale(order, registered=self.slave.registered)
        if stale or not isinstance(order, AmendInstance | SetLifecycleState):
            respond(self.obey(sent, now))
            return

        def settle(refusal: str, code: str) -> None:
            code = code if refusal else ""
            respond(happened.OrderAnswered(sent.order_id, not refusal, code, refusal))

        goal = order.amendment if isinstance(order, AmendInstance) else order.state
        self.unsettled[order.instance, goal].append(settle)
        self.tell(event_of(order), now)

    def _carry_out(self, command: commands.Command, now: float) -> None:
        match command:
            case commands.Settle(instance, goal, refusal, code) | commands.SettleLifecycle(
                instance, goal, refusal, code
            ):
                for settle in self.unsettled.pop((instance, goal), ()):
                    settle(refusal, code)
            case commands.ReadLifecycleState() | commands.ChangeLifecycleState():
                self._post(partial(self._reach_node, command))
            case _:
                super()._carry_out(command, now)

    def _reach_node(
        self, request: commands.ReadLifecycleState | commands.ChangeLifecycleState
    ) -> None:
        program = self.programs.get(request.instance)
        if program is not None and program.pid == request.pid:
            self.tell(self._answer_of_node(request), self.cluster.now)

    def _launch(self, assignment: Assignment, now: float) -> None:
        instance, spec = assignment.instance, assignment.spec
        held = self.slave.held[instance]
        silent = assignment.shadow or assignment.restored
        policy = RestartPolicy() if silent else spec.restart
        if held.amended is not None:
            policy = held.amended.restart
        order = told.StartOrdered(
            key_of(instance), restart_rule(policy), stop_rule(spec.stop),
            fence_rule(assignment.fence), self.slave.last_contact or None,
        )  # fmt: skip
        self.launches[instance] = Launch(order, assignment, held.memo)
        self._post(partial(self._take_launch, self.launches[instance]))

    def _supervise(self, command: commands.SupervisorCommand, now: float) -> None:
        if isinstance(command, commands.Stop | commands.Fence):
            self.launches.pop(command.instance, None)
        self._post(partial(self._take, command))

    def _post(self, action: Callable[[], None]) -> None:
        """Act after a moment, unless the slave or the supervisor is killed before."""
        runs = (self.slave_run, self.supervisor_run)

        def arrive() -> None:
            lives = self.slave_lives and self.supervisor_lives
            if lives and runs == (self.slave_run, self.supervisor_run):
                action()

        self.cluster.after(MOMENT, arrive)

    def kill_slave(self) -> None:
        """Kill the slave; another one starts soon."""
        self.slave_lives, self.host_id = False, 0
        self.slave_run += 1
        self.launches.clear()
        self.unsettled.clear()
        self._turned_back.clear()
        self.cluster.after(SLAVE_DOWN, self._start_slave)

    def _start_slave(self) -> None:
        self.slave_lives = True
        self.incarnation += 1000
        self.sequence = self.batches = 0
        self.slave = SlaveState()
        self._adopt()
        self.register()

    def register(self) -> None:
        """Register at the master, until it accepts."""
        snapshots = tuple(self.snapshots.values())
        if self.host_id or not self.slave_lives:
            return
        if not (self.connected and self.cluster.enter(self, 0, snapshots).accepted):
            self.cluster.after(0.3, self.register)

    def _adopt(self) -> None:
        """Connect the slave to the supervisor, and repeat the launches it does not know."""
        found = [self._status_of(one) for one in self.supervisor.instances.values()]
        for status in found:
            self.launches.pop(status.instance, None)
        for launch in self.launches.values():
            self._post(partial(self._take_launch, launch))
        launched = [InstanceStatus(one, InstanceState.STARTING) for one in self.launches]
        memos = {one: launch.memo for one, launch in self.launched.items()}
        fenced = [one for one, launch in self.launched.items() if launch.order.fence is not None]
        self.tell(
            events.SupervisorReplaced((*found, *launched), memos, frozenset(fenced)),
            self.cluster.now,
        )

    # --- the supervisor --------------------------------------------------------------------

    def _take_launch(self, launch: Launch) -> None:
        if launch.order.instance not in self.supervisor.instances:
            self.launched[launch.assignment.instance] = launch
        self.handle(launch.order)

    def _take(self, command: commands.SupervisorCommand) -> None:
        match command:
            case commands.Remember(instance, memo):
                if instance in self.launched:
                    self.launched[instance] = self.launched[instance]._replace(memo=memo)
            case commands.Amend(instance, amendment):
                policy = restart_rule(amendment.restart)
                self.handle(told.AmendOrdered(key_of(instance), policy))
                recorded = events.AmendmentRecorded(instance, amendment)
                self._post(partial(self._inform, recorded))
            case commands.Forget(instances):
                for instance in instances:
                    self.handle(told.StatusStored(key_of(instance)))
            case _:
                self.handle(_order_of(command))

    def handle(self, event: Any) -> None:
        """Process an event in the supervisor's core, and carry out its commands."""
        for command in self.supervisor.handle(event, self.cluster.now):
            assert not isinstance(command, acts.Leave)
            instance = InstanceId(*command.instance)
            match command:
                case acts.Spawn():
                    self.spawning.add(instance)
                    self.cluster.after(0.03, partial(self._spawn, instance, self.supervisor_run))
                case acts.Unspawn() if instance in self.spawning:
                    self.spawning.discard(instance)
                    self.handle(told.SpawnFailed(command.instance, ""))
                case acts.Signal(_, number) if instance in self.programs:
                    # Every process ends by SIGINT, so only a fence sends SIGKILL.
                    shadow = self.launched[instance].assignment.shadow
                    assert shadow or number != signal.SIGKILL, f"{instance} is killed"
                    pid = self.programs[instance].pid
                    self.cluster.after(0.2, partial(self.exit, instance, pid, signal=number))
                case acts.ReportStatus():
                    one = self.supervisor.instances[command.instance]
                    if one.phase != STARTING or one.started:
                        self._post(partial(self._report, self._status_of(one)))
                case acts.Drop():
                    self.launched.pop(instance, None)

    def _status_of(self, one: Instance) -> InstanceStatus:
        instance, state, *rest = messages.Status.of(one, self.cluster.now)
        return InstanceStatus(InstanceId(*instance), InstanceState(state), *rest)

    def _report(self, status: InstanceStatus) -> None:
        self.launches.pop(status.instance, None)
        self._inform(events.SupervisorReported((status,)))

    def _inform(self, event: events.Event) -> None:
        self.tell(event, self.cluster.now)

    def kill_supervisor(self) -> None:
        """Kill the supervisor; another one restores its record soon."""
        self.supervisor_lives = False
        self.supervisor_run += 1
        self.spawning.clear()
        self.cluster.after(SUPERVISOR_DOWN, self._start_supervisor)

    def _start_supervisor(self) -> None:
        former, self.supervisor = self.supervisor, SupervisorState()
        self.supervisor.dead, self.supervisor_lives = former.dead, True
        for one in former.instances.values():
            self.supervisor.restore(one)
        for one in list(self.supervisor.instances.values()):
            if one.phase == STARTING:
                self.handle(told.Resumed(one.key))
            elif one.pid and InstanceId(*one.key) not in self.programs:
                self.handle(told.Exited(one.key, UNKNOWN_EXIT))
        self._adopt()

    # --- processes -----------------------------------------------------------------------

    def _spawn(self, instance: InstanceId, run: int) -> None:
        if instance not in self.spawning or run != self.supervisor_run:
            return
        self.spawning.discard(instance)
        assignment, now = self.launched[instance].assignment, self.cluster.now
        assert instance not in self.programs, f"{instance} runs twice on {self.name}"
        program = self.make_program(assignment, assignment.spec.restart)
        program.state = InstanceState.RUNNING
        self.programs[instance] = program
        if self.supervisor.instances[key_of(instance)].begun is not None:
            self.run_begins_again(program, now)
        name = instance.process
        assert name not in self.cluster.finished, f"{name} has finished and begins again"
        self.handle(told.Spawned(key_of(instance), program.pid))
        _, *end = assignment.spec.command
        if end:
            seconds, code = end
            exits = partial(self.exit, instance, program.pid, code=int(code))
            self.cluster.after(float(seconds), exits)

    def exit(self, instance: InstanceId, pid: int, *, code: int = 0, signal: int = 0) -> None:
        """End a run of a process, which the supervisor sees unless it is dead."""
        program = self.programs.get(instance)
        if program is None or program.pid != pid:
            return
        del self.programs[instance]
        self.stand_still.pop(instance.number, None)
        if program.assignment.spec.kind is Kind.JOB and code == signal == 0:
            self.cluster.finished.add(instance.process)
        if self.supervisor_lives:
            self.handle(told.Exited(key_of(instance), code, signal))

    def _end(
        self, instance: InstanceId, state: InstanceState, now: float, *, code: int = 0,
        signal: int = 0,
    ) -> None:  # fmt: skip
        self.exit(instance, self.programs[instance].pid, code=code, signal=signal)

    def pass_time(self) -> None:
        """Check the deadlines, and show each node in the ROS graph."""
        now, due = self.cluster.now, self.supervisor.deadline()
        if self.supervisor_lives and due is not None and due <= now:
            self.handle(told.TimePassed())
        for instance, held in list(self.slave.awaited_in_graph().items()):
            program = self.programs.get(instance)
            if program is not None and program.pid == held.status.pid:
                self.tell(events.SeenInGraph(instance), now)
        self.tell(events.TimePassed(), now)


class ThreeCores(Cluster):
    """A master's core, and hosts with the cores of slave and supervisor.

    Attributes:
        fate_of: returns the fate of a message by its number (an index of `sent_messages`), and its
            description.
        sent_messages: descriptions of all messages since `disturb`.
        finished: names of the jobs that have ended with exit code 0.
    """

    def __init__(self, hosts: str) -> None:
        self.fate_of: FateOf = _arrives
        self.sent_messages: list[str] = []
        self.finished: set[str] = set()
        self._agenda: list[tuple[float, int, Callable[[], object]]] = []
        self._serial = count()
        self._awaited: set[Any] = set()
        moves = {"criu": by_criu(5.0), "lifecycle_node": LifecycleNode(LifecycleNodeOptions())}
        machines = [TimedHost(name, cluster=self) for name in hosts]
        super().__init__(*machines, strategies=moves)

    @property
    def hosts(self) -> list[TimedHost]:
        return list(self.machines.values())  # type: ignore[arg-type]

    # --- time and wires ------------------------------------------------------------------

    def after(self, seconds: float, action: Callable[[], object]) -> None:
        heapq.heappush(self._agenda, (self.now + seconds, next(self._serial), action))

    def wait(self, seconds: float, *, tick: float = 0.2) -> None:
        """Let time pass: messages arrive in their order, and each tick the rest happens."""
        for _ in range(round(seconds / tick)):
            began = self.now
            while self._agenda and self._agenda[0][0] <= began + tick:
                self.now, _, action = heapq.heappop(self._agenda)
                action()
                self.settle()
                self.check_processes()
            self.now = began
            super().wait(tick, tick=tick)
            for host in self.hosts:
                host.pass_time()

    def link(self, host: TimedHost, message: str, deliver: Callable[[], object]) -> None:
        """Send a message between the master and a slave; it may meet its fate."""
        runs = (self.state.epoch, host.slave_run)

        def arrive() -> None:
            if host.connected and runs == (self.state.epoch, host.slave_run):
                deliver()

        fate = self.fate_of(len(self.sent_messages), message)
        self.sent_messages.append(f"{message} ({host.name})")
        if fate not in ("lost", "late"):
            self.after(LATENCY, arrive)
        soon = LATENCY + MOMENT / 2
        faults: dict[str, tuple[float, Callable[[], None]]] = {
            "late": (LATE, arrive), "twice": (LATE, arrive),
            "slave killed": (soon, host.kill_slave),
            "supervisor killed": (soon, host.kill_supervisor),
            "master killed before": (0.0, self.kill_master),
            "master killed after": (soon, self.kill_master),
            "host cut": (0.0, partial(self._cut_off, [host], CUT)),
            "busy hosts cut": (0.5, self._cut_off_busy_hosts),
        }  # fmt: skip
        if fate in faults:
            self.after(*faults[fate])

    def disturb(self, fate_of: FateOf = _arrives) -> None:
        """Begin to count the messages, each of which meets its fate."""
        self.sent_messages.clear()
        self.fate_of = fate_of

    def _cut_off_busy_hosts(self) -> None:
        self._cut_off([host for host in self.hosts if host.programs], LONG_CUT)

    def _cut_off(self, hosts: list[TimedHost], seconds: float) -> None:
        for host in hosts:
            host.connected, host.host_id = False, 0
            self.after(seconds, partial(setattr, host, "connected", True))
            self.after(seconds, host.register)

    def kill_master(self) -> None:
        """Kill the master and restore it from its journal; the slaves register soon."""
        super().kill_master()
        self._awaited.clear()
        for host in self.hosts:
            host.host_id = 0
            self.after(MASTER_DOWN, host.register)

    def send(self, sent: SendOrder) -> None:
        host: Any = self.by_id(sent.host_id)
        name = f"{type(sent.order).__name__} {getattr(sent.order, 'instance', '')}"
        key = (self.state.epoch, sent.order_id)
        self._awaited.add(key)

        def end(answer: happened.OrderAnswered) -> None:
            if key in self._awaited:
                self._awaited.discard(key)
                self.tell(answer)

        def respond(answer: happened.OrderAnswered) -> None:
            self.link(host, f"answer to {name}", partial(end, answer))

        self.link(host, name, partial(host.receive, sent, respond))
        seconds = ORDER_TIMEOUT + seconds_of(sent.order)
        self.after(seconds, partial(end, happened.OrderAnswered.missing(sent.order_id)))

    def assign(self, host: Any, command: Assign) -> None:
        received = events.AssignmentsReceived((command.assignment,), self.now)
        name = f"assignment {command.assignment.instance}"
        self.link(host, name, lambda: host.tell(received, self.now))

    # --- what must hold --------------------------------------------------------------------

    def _programs(self) -> list[Program]:
        return [program for host in self.hosts for program in host.programs.values()]

    def check_processes(self) -> None:
        """Check that no process runs too often, and that at most one of its nodes is active."""
        programs = self._programs()
        for name, process in self.state.processes.items():
            own = [one for one in programs if one.assignment.instance.process == name]
            moves, spec = process.spec.migration, process.spec
            overlaps = moves.overlap if moves.strategy == "relaunch" else bool(moves.strategy)
            assert len(own) <= 1 + overlaps + spec.standby.wanted, f"{name} runs {len(own)} times"
            active = [one for one in own if one.lifecycle_state == "active"]
            if moves.strategy in ("handoff", "criu"):
                active = [one for one in own if one.node.active]
            assert len(active) <= 1, f"{name} has {len(active)} active nodes"

    def _policies(self) -> Iterator[tuple[MasterInstance, RestartRule]]:
        """Yield the owner of each process with the policy that its supervisor applies."""
        for process in self.state.processes.values():
            owner = self.state.owner_of(process)
            host: Any = None if owner is None else self.machines[owner.host.name]
            known = None if owner is None else host.supervisor.instances.get(key_of(owner.id))
            if owner is not None and known is not None:
                yield owner, known.restart

    def outcome(self) -> dict[str, tuple[str, int]]:
        """Return phase and number of instances of each process."""
        return {name: (self.phase(name), len(self.where(name))) for name in self.state.processes}

    def under_way(self) -> list[str]:
        """Return all that is not complete; at the end of a scenario nothing is."""
        state, specs = self.state, [one.assignment.spec for one in self._programs()]
        versions = {one.command[0] for one in specs if one.kind is not Kind.JOB}
        pending = state.pending_orders.pending
        held = [held for host in self.hosts for held in host.slave.held.values()]
        known = {one.id for one in state.instances.values()}
        tables: dict[str, Any] = {
            "migrations": state.migrations, "amendments": state.unamended,
            "awaited reports": state.reports_awaited,
            "orders": [one for one, it in pending.items() if it.expires < self.now - 1.0],
            "tasks": [one.name for one in state.applications.values() if one.tasks],
            "instances": [
                one.id for one in state.instances.values()
                if one.restarting or one.stopping or one.state is None
            ],
            "unknown": known ^ {one.assignment.instance for one in self._programs()},
            "answers": [host.name for host in self.hosts if host.unsettled],
            "slave": [
                one.status.instance for one in held
                if one.unsettled or one.steering or one.loading or one.ordered
            ],
            "versions": versions if len(versions) > 1 else (),
            "restart policies": [
                f"{one.id}: {policy.when}" for one, policy in self._policies()
                if policy != restart_rule(one.spec.restart)
            ],
        }  # fmt: skip
        return [f"{what}: {found}" for what, found in tables.items() if found]
