"""The cores of slave and supervisor together: orders that are lost, late or repeated.

`Host` has the wires between both: each is in order, and a kill of one side loses what is on its
way. The master's orders arrive in any order, and more than once.
"""

from __future__ import annotations

import json
from collections import Counter, deque
from typing import Any

import hypothesis.strategies as st
from hypothesis import HealthCheck, settings
from hypothesis.stateful import RuleBasedStateMachine, precondition, rule

from rosrm.core.slave import commands, events, reducer
from rosrm.core.slave.state import SlaveState
from rosrm.core.slave.watches import Memo
from rosrm.core.supervisor import commands as acts
from rosrm.core.supervisor import events as told
from rosrm.core.supervisor.instance import Instance
from rosrm.core.supervisor.reducer import SupervisorState
from rosrm.core.supervisor.rules import StopRule
from rosrm.model.values import (
    Amendment,
    Assignment,
    InstanceId,
    InstanceState,
    InstanceStatus,
    ProcessSpec,
    Readiness,
    RestartPolicy,
    Run,
)
from rosrm.slave.supervisor_client import _order_of
from rosrm.supervisor import messages
from rosrm.supervisor.client_values import key_of, restart_rule, status_from

STATE = InstanceState
NODE = ProcessSpec("n", module="m", ros=True, readiness=Readiness(timeout=10.0))
PLAIN = ProcessSpec("p", command=("true",), restart=RestartPolicy("on-failure", delay=1.0))
SPECS = {"n": NODE, "p": PLAIN}
INSTANCES = st.builds(InstanceId, st.sampled_from(list(SPECS)), st.integers(1, 2))
POLICIES = st.sampled_from([RestartPolicy("never"), RestartPolicy("always", delay=1.0)])


class Host:
    """Slave and supervisor of one host, with the processes that really run."""

    def __init__(self) -> None:
        self.now, self.pids = 100.0, 1000
        self.slave = SlaveState(registered=True)
        self.supervisor = SupervisorState()
        self.memos: dict[InstanceId, Memo] = {}
        self.ordered: deque[commands.Command] = deque()
        self.reported: deque[InstanceStatus] = deque()
        self.unanswered: dict[InstanceId, commands.Launch] = {}
        self.running: dict[tuple[str, int], int] = {}
        self.signalled: set[tuple[str, int]] = set()
        self.restarted: Counter[tuple[InstanceId, Run]] = Counter()
        self.ended: set[tuple[str, int]] = set()

    # --- the slave -----------------------------------------------------------------------

    def tell(self, event: events.Event) -> None:
        """Process an event in the slave's core, and send its commands to the supervisor."""
        for command in reducer.step_all(self.slave, [event], self.now):
            if isinstance(command, commands.Launch):
                for one in command.assignments:
                    launch = self.unanswered[one.instance] = commands.Launch((one,))
                    self.ordered.append(launch)
            elif isinstance(command, commands.SupervisorCommand):
                if isinstance(command, commands.Stop | commands.Fence):
                    self.unanswered.pop(command.instance, None)
                self.ordered.append(command)

    def restart_slave(self) -> None:
        """Kill the slave: the supervisor still reads what it has sent."""
        self.read_all()
        self.slave, self.unanswered = SlaveState(registered=True), {}
        self.reported.clear()
        self.take_over()

    def kill_supervisor(self, *, reads: bool) -> None:
        """Kill the supervisor; the next one has its record, and unread orders are lost."""
        if reads:
            self.read_all()
        self.ordered.clear()
        self.reported.clear()
        former, self.supervisor = self.supervisor, SupervisorState()
        self.supervisor.dead = former.dead
        for instance in former.instances.values():
            self.supervisor.restore(instance)
        self.take_over()

    def take_over(self) -> None:
        """Connect the slave to the supervisor."""
        found = [self.status_of(one) for one in self.supervisor.instances.values()]
        for status in found:
            self.unanswered.pop(status.instance, None)
        self.ordered.extend(self.unanswered.values())
        launched = [InstanceStatus(one, STATE.STARTING) for one in self.unanswered]
        live = {one.instance for one in found if not one.state.ended}
        memos = {one: memo for one, memo in self.memos.items() if one in live}
        self.tell(events.SupervisorReplaced((*found, *launched), memos))

    # --- the supervisor --------------------------------------------------------------------

    def status_of(self, instance: Instance) -> InstanceStatus:
        return status_from(json.loads(json.dumps(messages.Status.of(instance, self.now))))

    def read(self) -> None:
        """Let the supervisor read one order."""
        command = self.ordered.popleft()
        match command:
            case commands.Launch((one,)):
                self.memos[one.instance] = Memo()
                rule_ = restart_rule(one.spec.restart)
                self.handle(told.StartOrdered(key_of(one.instance), rule_, StopRule()))
            case commands.Remember(instance, memo):
                self.memos[instance] = memo
            case commands.Forget(instances):
                for instance in instances:
                    self.handle(told.StatusStored(key_of(instance)))
            case commands.Amend(instance, amendment):
                policy = restart_rule(amendment.restart)
                self.handle(told.AmendOrdered(key_of(instance), policy))
                self.tell(events.AmendmentRecorded(instance, amendment))
            case commands.Restart(instance, run):
                key = key_of(instance)
                before = self.was_ordered_to_restart(key)
                self.handle(told.RestartOrdered(key, run and (run.pid, run.restarts)))
                if run is not None and self.was_ordered_to_restart(key) and not before:
                    self.restarted[instance, run] += 1
            case _:
                self.handle(_order_of(command))

    def was_ordered_to_restart(self, key: tuple[str, int]) -> bool:
        one = self.supervisor.instances.get(key)
        return one is not None and one.then == "restart"

    def read_all(self) -> None:
        while self.ordered:
            self.read()

    def handle(self, event: Any) -> None:
        """Process an event in the supervisor's core, and carry out its commands."""
        for command in self.supervisor.handle(event, self.now):
            key = command.instance if not isinstance(command, acts.Leave) else ("", 0)
            match command:
                case acts.Spawn():
                    assert key not in self.ended, "an ended instance starts again"
                    assert key not in self.running, "an instance runs twice"
                    self.pids += 1
                    self.running[key] = self.pids
                    self.handle(told.Spawned(key, self.pids))
                case acts.Signal():
                    self.signalled.add(key)
                case acts.ReportStatus():
                    status = self.status_of(self.supervisor.instances[key])
                    if status.state.ended:
                        self.ended.add(key)
                    self.reported.append(status)

    def end(self, key: tuple[str, int], code: int = 0) -> None:
        """End a process."""
        del self.running[key]
        self.signalled.discard(key)
        self.handle(told.Exited(key, code))

    def settle(self) -> None:
        """Deliver all messages, and end what has got a signal, until nothing happens."""
        while self.ordered or self.reported or self.signalled:
            self.read_all()
            while self.reported:
                status = self.reported.popleft()
                self.unanswered.pop(status.instance, None)
                self.tell(events.SupervisorReported((status,)))
            for key in list(self.signalled):
                self.end(key)

    def pass_time(self, seconds: float) -> None:
        self.now += seconds
        self.handle(told.TimePassed())
        self.tell(events.TimePassed())


class Orders(RuleBasedStateMachine):
    """Orders of a master, whose copies arrive late, to a host whose parts are killed."""

    def __init__(self) -> None:
        super().__init__()
        self.host = Host()
        self.sent: list[events.Event] = []

    def order(self, event: events.Event) -> None:
        self.sent.append(event)
        self.host.tell(event)

    @rule(instance=INSTANCES)
    def start(self, instance: InstanceId) -> None:
        assignment = Assignment(instance, SPECS[instance.process], 1, instance.process)
        self.order(events.AssignmentsReceived((assignment,)))

    @rule(instance=INSTANCES)
    def stop(self, instance: InstanceId) -> None:
        self.order(events.StopOrdered(instance))

    @rule(instance=INSTANCES)
    def fence(self, instance: InstanceId) -> None:
        self.order(events.FenceOrdered(instance))

    @rule(instance=INSTANCES, policy=POLICIES)
    def amend(self, instance: InstanceId, policy: RestartPolicy) -> None:
        self.order(events.AmendmentOrdered(instance, Amendment(policy)))

    @rule(instance=INSTANCES)
    def restart(self, instance: InstanceId) -> None:
        """Order a restart of the run that the slave has reported."""
        held = self.host.slave.held.get(instance)
        if held is not None and held.status.state not in (None, STATE.HELD):
            run = Run(held.status.pid, held.status.restarts)
            self.order(events.RestartOrdered(instance, run))

    @precondition(lambda self: self.sent)
    @rule(which=st.integers(0, 20))
    def a_copy_arrives_late(self, which: int) -> None:
        self.host.tell(self.sent[which % len(self.sent)])

    @precondition(lambda self: self.host.ordered)
    @rule()
    def supervisor_reads(self) -> None:
        self.host.read()

    @precondition(lambda self: self.host.reported)
    @rule()
    def slave_reads(self) -> None:
        status = self.host.reported.popleft()
        self.host.unanswered.pop(status.instance, None)
        self.host.tell(events.SupervisorReported((status,)))

    @precondition(lambda self: self.host.running)
    @rule(which=st.integers(0, 3), code=st.integers(0, 1))
    def process_ends(self, which: int, code: int) -> None:
        self.host.end(list(self.host.running)[which % len(self.host.running)], code)

    @rule(instance=INSTANCES)
    def node_is_seen(self, instance: InstanceId) -> None:
        self.host.tell(events.SeenInGraph(instance))

    @rule(seconds=st.sampled_from([0.5, 2.0, 11.0, 61.0]))
    def time_passes(self, seconds: float) -> None:
        self.host.pass_time(seconds)

    @rule()
    def slave_is_killed(self) -> None:
        self.host.restart_slave()

    @rule(reads=st.booleans())
    def supervisor_is_killed(self, reads: bool) -> None:
        self.host.kill_supervisor(reads=reads)

    @rule()
    def all_arrives(self) -> None:
        """Slave and supervisor agree once nothing is on its way."""
        host = self.host
        host.settle()
        theirs = {
            host.status_of(one).instance: host.status_of(one)
            for one in host.supervisor.instances.values()
            if not one.ended
        }
        ours = {one: held.status for one, held in host.slave.alive.items()}
        assert ours.keys() == theirs.keys()
        for instance, status in theirs.items():
            mine = ours[instance]
            expected = (STATE.RUNNING, STATE.READY) if status.pid else (status.state,)
            assert mine.state in expected, instance
            assert (mine.pid, mine.restarts) == (status.pid, status.restarts), instance
            becomes_ready = host.slave.held[instance].ready_by is not None
            assert becomes_ready is (mine.state is STATE.RUNNING), instance
        assert all(number <= 1 for number in host.restarted.values()), host.restarted

    def teardown(self) -> None:
        """Check that each instance ends when the master orders it."""
        self.all_arrives()
        for instance in list(self.host.slave.alive):
            self.host.tell(events.StopOrdered(instance))
        self.all_arrives()
        assert not self.host.running


TestOrders = Orders.TestCase
TestOrders.settings = settings(
    max_examples=60, stateful_step_count=40, deadline=None, derandomize=True,
    suppress_health_check=list(HealthCheck),
)  # fmt: skip
