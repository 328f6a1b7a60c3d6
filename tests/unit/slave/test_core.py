"""Reducer of the slave: orders, supervisor reports, readiness and restart policies."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule

from rosrm.core.slave import commands as slave_commands
from rosrm.core.slave import reducer
from rosrm.core.slave.events import (
    AssignmentsReceived,
    ContactConfirmed,
    FenceOrdered,
    LaunchRefused,
    LookedAt,
    MasterLost,
    Registered,
    ReportRequested,
    RestartOrdered,
    RestartPolicyRecorded,
    RestartPolicySet,
    SeenInGraph,
    StopOrdered,
    SupervisorReplaced,
    SupervisorReported,
    TimePassed,
)
from rosrm.core.slave.handlers import REMEMBER_END
from rosrm.core.slave.health import LOOK_PERIOD
from rosrm.core.slave.state import HeldInstance, SlaveState, awaits_graph, under_limits
from rosrm.core.slave.watches import Memo, Observation
from rosrm.model.values import (
    Assignment,
    Fence,
    Health,
    InstanceId,
    InstanceState,
    InstanceStatus,
    ProcessSpec,
    Readiness,
    RestartPolicy,
)
from rosrm.slave.memos import from_memo, to_memo

PLAIN = ProcessSpec("p", command=("true",))
NODE = ProcessSpec("n", module="m", ros=True, namespace="/robot", readiness=Readiness(timeout=10.0))
STATE = InstanceState


def assigned(spec=PLAIN, number=1, epoch=1, fence=None) -> AssignmentsReceived:
    assignment = Assignment(InstanceId(spec.name, number), spec, epoch, spec.name, fence=fence)
    return AssignmentsReceived((assignment,))


def told(state, name="p", number=1, **more) -> SupervisorReported:
    return SupervisorReported((InstanceStatus(InstanceId(name, number), state, **more),))


class Slave:
    """State of a slave's reducer, with its clock."""

    def __init__(self) -> None:
        self.state = SlaveState(registered=True)
        self.now = 100.0

    def step(self, event, after=0.0):
        self.now += after
        return list(reducer.step(self.state, event, self.now))

    def of(self, name="p", number=1) -> HeldInstance:
        return self.state.held[InstanceId(name, number)]


@pytest.fixture
def one() -> Slave:
    return Slave()


def test_an_instance_lost_with_its_supervisor_cannot_be_refused_any_more(one):
    """The instance was starting when its supervisor was killed: no supervisor holds it."""
    one.step(assigned())
    one.step(SupervisorReplaced((), {}, frozenset()))
    assert one.step(LaunchRefused(InstanceId("p", 1), "no such package")) == []


def test_what_the_supervisor_lost_at_once_is_not_launched(one):
    """An assignment and the next supervisor in one batch start nothing.

    The next supervisor does not know the instance. The master repeats the assignment and receives
    the refusal.
    """
    events = [assigned(), SupervisorReplaced((), {}, frozenset())]
    commands = reducer.step_all(one.state, events, one.now)
    assert [c for c in commands if isinstance(c, slave_commands.Launch) and c.assignments] == []
    (report,) = one.step(assigned(), after=2.0)
    assert states([report]) == [STATE.REFUSED]


def awaited_names(one: Slave) -> list[str]:
    """Return the names of the nodes that the slave awaits in the graph."""
    return [h.awaited.node_name for h in one.state.awaited_in_graph().values()]


def states(commands) -> list[InstanceState]:
    """Return the reported states."""
    return [s.state for c in commands if isinstance(c, slave_commands.Report) for s in c.statuses]


def test_an_assignment_is_launched_once(one) -> None:
    """A repeated order starts nothing."""
    assert [type(c) for c in one.step(assigned())] == [slave_commands.Launch]
    assert one.step(assigned()) == []
    one.step(told(STATE.RUNNING, pid=5))
    one.step(told(STATE.EXITED))
    assert one.step(assigned()) == []


def test_a_change_during_the_registration_is_reported(one) -> None:
    """The registration request had the older status, and no batch was published without a link."""
    one.step(assigned())
    one.step(told(STATE.RUNNING, pid=5))
    one.step(MasterLost())
    one.step(told(STATE.FAILED, exit_signal=9))
    (report,) = one.step(Registered(1))
    assert (states([report]), report.complete) == ([STATE.FAILED], False)


def test_a_registration_without_a_change_needs_no_report(one) -> None:
    """The request had all statuses."""
    one.step(assigned())
    one.step(told(STATE.RUNNING, pid=5))
    one.step(MasterLost())
    assert one.step(Registered(2)) == []


def test_an_older_epoch_starts_nothing(one) -> None:
    """Orders of a replaced master have no effect; the refusal names both epochs."""
    one.step(Registered(3))
    assert states(one.step(assigned(epoch=2))) == [STATE.REFUSED]
    assert "epoch 2" in one.of().status.message


def test_a_registration_sets_the_epoch(one) -> None:
    """A master with a lost journal begins at epoch 1 again, and this host works for it."""
    one.step(Registered(7))
    one.step(Registered(1))
    assert [type(c) for c in one.step(assigned(epoch=1))] == [slave_commands.Launch]


def test_stopped_before_it_was_started(one) -> None:
    """A stop that overtakes its start wins: a later start is refused for good."""
    assert states(one.step(StopOrdered(InstanceId("p", 1)))) == [STATE.REFUSED]
    assert one.step(assigned()) == []
    one.step(TimePassed(), after=REMEMBER_END)
    assert states(one.step(assigned())) == [STATE.REFUSED]


@pytest.mark.parametrize("end", ["refused", "exited"])
def test_a_dead_number_stays_dead(one, end) -> None:
    """A late order of the same instance starts nothing, even after its end was forgotten."""
    one.step(assigned())
    if end == "refused":
        one.step(LaunchRefused(InstanceId("p", 1), "no such package"))
    else:
        one.step(told(STATE.EXITED))
    forgotten = one.step(TimePassed(), after=REMEMBER_END)
    assert forgotten == [slave_commands.Forget((InstanceId("p", 1),))]
    assert states(one.step(assigned())) == [STATE.REFUSED]
    assert [type(c) for c in one.step(assigned(number=2))] == [slave_commands.Launch]


def test_dead_numbers_are_given_again_by_a_master_that_has_lost_its_journal(one) -> None:
    """A master with a lost journal may reuse them; a repeated registration changes nothing."""
    one.step(StopOrdered(InstanceId("p", 1)))
    one.step(Registered(1))
    one.step(TimePassed(), after=REMEMBER_END)
    assert states(one.step(assigned())) == [STATE.REFUSED]
    one.step(Registered(1, renumbers=True))
    one.step(TimePassed(), after=REMEMBER_END)
    assert [type(c) for c in one.step(assigned())] == [slave_commands.Launch]


def test_an_end_is_kept_until_a_master_knows_it(one) -> None:
    """The slave keeps the end of a job until a master has learned it, however long that takes."""
    one.step(assigned())
    one.step(MasterLost())
    one.step(told(STATE.EXITED))
    assert one.step(TimePassed(), after=10 * REMEMBER_END) == []
    one.step(Registered(2))
    assert one.step(TimePassed(), after=REMEMBER_END / 2) == []
    assert len(one.step(TimePassed(), after=REMEMBER_END)) == 1


def test_a_number_refused_for_its_epoch_may_be_used_by_a_newer_master(one) -> None:
    """Only the order was too old: a newer master may still use the instance's number."""
    one.step(Registered(3))
    one.step(assigned(epoch=2, number=8))
    assert states(one.step(assigned(epoch=3, number=9))) == []
    assert one.of(number=9).status.state is STATE.STARTING


def test_a_refused_launch_is_reported(one) -> None:
    """The reason reaches the master."""
    one.step(assigned())
    (report,) = one.step(LaunchRefused(InstanceId("p", 1), "no such package"))
    assert report.statuses[0].state is STATE.REFUSED
    assert report.statuses[0].message == "no such package"


def test_a_process_is_ready_as_soon_as_it_runs(one) -> None:
    """Only ROS nodes need more than a running process."""
    one.step(assigned())
    assert states(one.step(told(STATE.RUNNING, pid=5))) == [STATE.READY]
    assert one.step(told(STATE.RUNNING, pid=5)) == []


def test_a_node_is_ready_when_it_is_seen(one) -> None:
    """The slave awaits the node under its qualified name, and reports it ready once."""
    one.step(assigned(NODE))
    assert one.state.awaited_in_graph() == {}
    assert states(one.step(told(STATE.RUNNING, "n", pid=5))) == [STATE.RUNNING]
    assert awaited_names(one) == ["/robot/n"]
    assert states(one.step(SeenInGraph(InstanceId("n", 1)))) == [STATE.READY]
    assert one.step(SeenInGraph(InstanceId("n", 1))) == []
    assert one.state.awaited_in_graph() == {}


def test_a_shadow_is_awaited_under_its_alias(one) -> None:
    """The source has the node's own name; the shadow's alias shows in the graph when ready."""
    shadow = Assignment(InstanceId("n", 2), NODE, 1, "n_1700000000", shadow=True)
    one.step(AssignmentsReceived((shadow,)))
    one.step(told(STATE.RUNNING, "n", 2, pid=5))
    assert awaited_names(one) == ["/robot/n_1700000000"]
    assert states(one.step(SeenInGraph(InstanceId("n", 2)))) == [STATE.READY]


def test_readiness_kinds(one) -> None:
    """`running` makes a node ready at once; with `graph` the slave awaits any process."""
    running = replace(NODE, readiness=Readiness("running"))
    graph = replace(PLAIN, readiness=Readiness("graph"))
    assert not awaits_graph(running)
    assert awaits_graph(graph)
    assert awaits_graph(NODE)
    assert not awaits_graph(PLAIN)


def test_an_instance_that_does_not_become_ready_is_stopped_and_has_failed(one) -> None:
    """The time-out is the reason, whatever the exit code."""
    one.step(assigned(NODE))
    one.step(told(STATE.RUNNING, "n", pid=5))
    assert one.step(TimePassed(), after=9.9) == []
    assert one.step(TimePassed(), after=0.2) == [slave_commands.Stop(InstanceId("n", 1))]
    assert one.step(TimePassed(), after=1.0) == []
    assert states(one.step(told(STATE.STOPPING, "n", pid=5))) == [STATE.STOPPING]
    (report,) = one.step(told(STATE.EXITED, "n"))
    assert report.statuses[0].state is STATE.FAILED
    assert "not ready within 10 s" in report.statuses[0].message
    assert "/robot/n" in report.statuses[0].message


def test_each_run_has_its_own_time_to_become_ready(one) -> None:
    """After a crash and restart the node must appear in the graph again."""
    one.step(assigned(NODE))
    one.step(told(STATE.RUNNING, "n", pid=5))
    one.step(SeenInGraph(InstanceId("n", 1)))
    assert states(one.step(told(STATE.BACKOFF, "n"), after=60.0)) == [STATE.BACKOFF]
    assert one.state.awaited_in_graph() == {}
    assert states(one.step(told(STATE.STARTING, "n"))) == [STATE.STARTING]
    assert states(one.step(told(STATE.RUNNING, "n", pid=6))) == [STATE.RUNNING]
    assert one.step(TimePassed(), after=9.0) == []
    assert states(one.step(SeenInGraph(InstanceId("n", 1)))) == [STATE.READY]


def test_an_instance_of_a_former_run_of_the_slave_is_ready(one) -> None:
    """Its spec is lost, but the process runs and keeps running."""
    assert states(one.step(told(STATE.RUNNING, "n", pid=5))) == [STATE.READY]
    assert one.step(TimePassed(), after=1000.0) == []
    assert one.step(assigned(NODE)) == []


# --- a later run of the slave -----------------------------------------------------------------

NODE_1 = InstanceId("n", 1)


def memo_of(commands) -> Memo:
    """Return the memo for the supervisor as a later run reads it."""
    (memo,) = [c.memo for c in commands if isinstance(c, slave_commands.Remember)]
    return from_memo(to_memo(memo))


def taken_over(one: Slave, status: InstanceStatus, memo: Memo) -> Slave:
    """Return a later run of the slave that re-adopts this instance from the supervisor."""
    later = Slave()
    later.now = one.now
    later.step(SupervisorReplaced((status,), {status.instance: memo}))
    return later


def test_a_node_that_was_still_awaited_is_awaited_by_the_next_slave(one) -> None:
    """The next slave waits for the node, whose first slave was killed before the node was ready."""
    one.step(assigned(NODE))
    awaited = from_memo(to_memo(one.of("n").memo))
    later = taken_over(one, InstanceStatus(NODE_1, STATE.RUNNING, pid=5), awaited)
    assert later.of("n").status.state is STATE.RUNNING
    assert awaited_names(later) == ["/robot/n"]
    assert later.step(TimePassed(), after=9.9) == []
    assert later.step(TimePassed(), after=0.2) == [slave_commands.Stop(NODE_1)]


def test_a_node_that_was_seen_is_ready_for_the_next_slave(one) -> None:
    """Readiness holds for the run that was seen; the next run must appear in the graph again."""
    one.step(assigned(NODE))
    one.step(told(STATE.RUNNING, "n", pid=5))
    awaited = memo_of(one.step(SeenInGraph(NODE_1)))
    later = taken_over(one, InstanceStatus(NODE_1, STATE.RUNNING, pid=5), awaited)
    assert later.of("n").status.state is STATE.READY
    assert later.step(TimePassed(), after=1000.0) == []
    later.step(told(STATE.BACKOFF, "n"))
    assert states(later.step(told(STATE.RUNNING, "n", pid=6))) == [STATE.RUNNING]
    assert awaited_names(later) == ["/robot/n"]
    later = taken_over(one, InstanceStatus(NODE_1, STATE.RUNNING, pid=6), awaited)
    assert later.of("n").status.state is STATE.RUNNING


MEMO = '{"awaited": ["/n", "soon", 0], "watch": null}'


@pytest.mark.parametrize("memo", ["", "{}", "[1]", "nothing", '["/n", 1.0, 0]', MEMO])
def test_a_memo_of_another_version_is_none(memo) -> None:
    """A memo of an unknown version is ignored."""
    assert from_memo(memo) is None


# --- another restart policy -------------------------------------------------------------------

ONE = InstanceId("p", 1)
NEVER = RestartPolicy("never")
ON_FAILURE = RestartPolicy("on-failure")


def running() -> Slave:
    """Return a slave with one running instance."""
    one = Slave()
    one.step(assigned())
    one.step(told(STATE.RUNNING, pid=5))
    return one


def test_a_restart_policy_is_settled_when_it_is_recorded() -> None:
    """Each repeated order is acknowledged, with the instance's status."""
    one = running()
    for _ in range(2):
        assert one.step(RestartPolicySet(ONE, NEVER)) == [slave_commands.Amend(ONE, NEVER)]
        report, settled = one.step(RestartPolicyRecorded(ONE, NEVER))
        assert states([report]) == [STATE.READY]
        assert settled == slave_commands.Settle(ONE, NEVER)


def test_a_restart_policy_of_a_re_adopted_instance() -> None:
    """The slave lost its spec, but the supervisor has all that is needed."""
    one = Slave()
    one.step(SupervisorReplaced((InstanceStatus(ONE, STATE.RUNNING, pid=5),)))
    assert one.step(RestartPolicySet(ONE, NEVER)) == [slave_commands.Amend(ONE, NEVER)]


def test_a_restart_policy_is_ordered_again_from_another_supervisor() -> None:
    """The killed supervisor may have recorded it or not; the next one's answer counts."""
    one = running()
    one.step(RestartPolicySet(ONE, NEVER))
    replaced = SupervisorReplaced((InstanceStatus(ONE, STATE.RUNNING, pid=5),))
    assert slave_commands.Amend(ONE, NEVER) in one.step(replaced)
    one.step(RestartPolicyRecorded(ONE, NEVER))
    assert [type(c) for c in one.step(replaced)] == [slave_commands.Report]


def test_an_older_policy_that_is_recorded_does_not_settle_a_newer_one() -> None:
    """Both were in progress: each order has its own answer."""
    one = running()
    one.step(RestartPolicySet(ONE, NEVER))
    one.step(RestartPolicySet(ONE, ON_FAILURE))
    assert one.step(RestartPolicyRecorded(ONE, NEVER))[-1] == slave_commands.Settle(ONE, NEVER)
    replaced = SupervisorReplaced((InstanceStatus(ONE, STATE.RUNNING, pid=5),))
    assert one.step(replaced)[:-1] == [slave_commands.Amend(ONE, ON_FAILURE)]


def test_a_restart_policy_of_an_ended_instance_reports_its_end() -> None:
    """The master receives the end, so its plan continues; the same holds for an end in between."""
    one = running()
    one.step(RestartPolicySet(ONE, NEVER))
    one.step(told(STATE.FAILED))
    report, settled = one.step(RestartPolicySet(ONE, NEVER))
    assert states([report]) == [STATE.FAILED]
    assert settled == slave_commands.Settle(ONE, NEVER)
    replaced = SupervisorReplaced((InstanceStatus(ONE, STATE.FAILED),))
    assert slave_commands.Settle(ONE, NEVER) in one.step(replaced)


def test_a_restart_policy_of_an_unknown_instance_is_refused() -> None:
    """The order is refused also if only a killed supervisor could have known the instance."""
    one = Slave()
    (settled,) = one.step(RestartPolicySet(ONE, NEVER))
    assert "p#1 is not known here" in settled.refusal
    one = running()
    one.step(RestartPolicySet(ONE, NEVER))
    settled = one.step(SupervisorReplaced(()))[0]
    assert isinstance(settled, slave_commands.Settle)
    assert settled.refusal


def test_a_restart_policy_of_a_held_instance() -> None:
    """The waiting instance starts with the new policy, and not as a shadow."""
    one = running()
    one.state.max_processes = 1
    shadow = Assignment(InstanceId("p", 2), PLAIN, 1, "p_1700000000", shadow=True)
    one.step(AssignmentsReceived((shadow,)))
    _, settled = one.step(RestartPolicySet(InstanceId("p", 2), ON_FAILURE))
    assert settled == slave_commands.Settle(InstanceId("p", 2), ON_FAILURE)
    (launch,) = [c for c in one.step(told(STATE.EXITED)) if isinstance(c, slave_commands.Launch)]
    (assignment,) = launch.assignments
    assert assignment.spec.restart == ON_FAILURE
    assert not assignment.shadow


def nodes(count: int) -> AssignmentsReceived:
    specs = [replace(NODE, name=f"n{number}") for number in range(count)]
    return AssignmentsReceived(
        tuple(Assignment(InstanceId(spec.name, 1), spec, 1, spec.name) for spec in specs)
    )


def launched(commands) -> list[str]:
    launches = [one for one in commands if isinstance(one, slave_commands.Launch)]
    return [one.instance.process for launch in launches for one in launch.assignments]


def test_at_most_max_starting_instances_start_at_a_time(one) -> None:
    """The others are held and reported; the next one starts once one is ready."""
    one.state.max_starting = 2
    commands = one.step(nodes(4))
    assert launched(commands) == ["n0", "n1"]
    assert states(commands) == [STATE.HELD, STATE.HELD]
    assert "max_starting: 2" in one.of("n2").status.message
    assert launched(one.step(told(STATE.RUNNING, "n0", pid=5))) == []
    assert launched(one.step(SeenInGraph(InstanceId("n0", 1)))) == ["n2"]


def test_an_instance_that_ends_before_it_is_ready_frees_its_slot(one) -> None:
    """An instance that is stopped because it is not ready in time makes room, too."""
    one.state.max_starting = 1
    one.step(nodes(3))
    assert launched(one.step(told(STATE.FAILED, "n0", exit_code=1))) == ["n1"]
    one.step(told(STATE.RUNNING, "n1", pid=5))
    assert one.step(TimePassed(), after=11.0) == [slave_commands.Stop(InstanceId("n1", 1))]
    assert launched(one.step(told(STATE.STOPPING, "n1", pid=5))) == ["n2"]


def test_a_plain_program_has_started_as_soon_as_it_runs(one) -> None:
    """A bound on starts hardly delays plain programs."""
    one.state.max_starting = 1
    one.step(assigned(number=1))
    one.step(assigned(replace(PLAIN, name="q")))
    assert launched(one.step(told(STATE.RUNNING, pid=5))) == ["q"]


def test_a_restart_policy_of_a_forgotten_instance_is_settled() -> None:
    """The supervisor never records it, but the master still receives an answer."""
    one = running()
    one.step(Registered(1))
    one.step(RestartPolicySet(ONE, NEVER))
    one.step(told(STATE.EXITED))
    commands = one.step(TimePassed(), after=100.0)
    assert slave_commands.Settle(ONE, NEVER) in commands


def test_stop_and_restart_go_to_the_supervisor(one) -> None:
    """An ended instance is reported again; a restart of an unknown one has no effect."""
    instance = InstanceId("p", 1)
    one.step(assigned())
    one.step(told(STATE.RUNNING, pid=5))
    assert one.step(RestartOrdered(instance)) == [slave_commands.Restart(instance)]
    assert one.step(StopOrdered(instance)) == [slave_commands.Stop(instance)]
    one.step(told(STATE.EXITED))
    assert states(one.step(StopOrdered(instance))) == [STATE.EXITED]
    assert states(one.step(RestartOrdered(instance))) == [STATE.EXITED]
    assert one.step(RestartOrdered(InstanceId("q", 2))) == []


def test_a_complete_report_names_everything(one) -> None:
    """The report includes ended instances that are still remembered."""
    one.step(assigned())
    one.step(assigned(number=2))
    one.step(told(STATE.EXITED))
    (report,) = one.step(ReportRequested())
    assert report.complete
    assert {s.instance.number: s.state for s in report.statuses} == {
        1: STATE.EXITED, 2: STATE.STARTING,
    }  # fmt: skip


@pytest.mark.parametrize(
    ("usage", "present", "stale", "under"),
    [
        ([0.1, 0.2], 0b11, 0, True),
        ([0.1, 0.9], 0b11, 0, False),  # over the limit
        ([0.1, 0.5], 0b11, 0, False),  # at the limit
        ([0.1, np.nan], 0b11, 0, False),  # unknown
        ([0.1, 0.2], 0b11, 0b10, False),  # stale, and limited
        ([0.1, 0.2], 0b11, 0b01, True),  # stale, but without a limit
        ([1.0, 0.2], 0b11, 0b01, True),  # never read, but without a limit
        ([1.5, 0.2], 0b11, 0, True),  # used up, but without a limit
        ([0.1, 0.9], 0b01, 0, True),  # unused
        ([], 0, 0, True),  # no probe at all
    ],
)
def test_a_host_is_under_its_limits_where_each_limited_reading_is(
    usage, present, stale, under
) -> None:
    """Every reading that has a limit is fresh and under it."""
    values = np.zeros(16, np.float32)
    values[: len(usage)] = usage
    limit = np.ones(16, np.float32)
    limit[1] = 0.5
    assert under_limits(values, limit, present, stale) is under


# --- any order of events ----------------------------------------------------------------------

NUMBERS = st.integers(1, 4)
WATCHED = ProcessSpec("w", command=("true",), health=Health(timeout=0.5), restart=ON_FAILURE)
SPECS = st.sampled_from([PLAIN, NODE, WATCHED])


FENCES = st.none() | st.builds(Fence, st.sampled_from([1.0, 5.0]), st.just(1.0))


class AnySlave(RuleBasedStateMachine):
    """State machine with a supervisor that carries out and reports each order after a delay."""

    def __init__(self) -> None:
        super().__init__()
        self.state = SlaveState()
        self.now = 0.0
        self.launched: list[InstanceId] = []
        self.alive: dict[InstanceId, InstanceState] = {}
        self.reported: dict[InstanceId, InstanceState] = {}
        self.stopped: set[InstanceId] = set()
        self.amending: list[tuple[InstanceId, RestartPolicy]] = []
        self.unsettled: set[tuple[InstanceId, RestartPolicy]] = set()
        self.heard_at = 0.0

    def feed(self, event) -> None:
        for command in reducer.step(self.state, event, self.now):
            if isinstance(command, slave_commands.Launch):
                for assignment in command.assignments:
                    self.check_fence(assignment)
                    self.launched.append(assignment.instance)
                    self.alive[assignment.instance] = STATE.STARTING
            elif isinstance(command, slave_commands.Report):
                for status in command.statuses:
                    self.reported[status.instance] = status.state
            elif isinstance(command, (slave_commands.Stop, slave_commands.Fence)):
                assert command.instance in self.alive, "a stop of what does not run"
                self.stopped.add(command.instance)
            elif isinstance(command, slave_commands.Fail):
                runs = self.alive.get(command.instance) is STATE.RUNNING
                assert runs, "a run failed that does not run"
                assert command.pid == 7, "another run than the one that was looked at"
            elif isinstance(command, slave_commands.Amend):
                assert command.instance in self.alive, "a policy for what does not run"
                self.amending.append((command.instance, command.restart))
            elif isinstance(command, slave_commands.Settle):
                self.unsettled.discard((command.instance, command.restart))
            elif isinstance(command, slave_commands.Forget):
                assert not self.alive.keys() & set(command.instances), "a live one forgotten"

    def check_fence(self, assignment) -> None:
        fence = assignment.fence
        late = fence is not None and self.now >= self.heard_at + fence.after
        assert not late or fence.alive, "started when its successor may run"

    @rule(spec=SPECS, number=NUMBERS, epoch=st.integers(1, 3), fence=FENCES)
    def assign(self, spec, number, epoch, fence) -> None:
        self.feed(assigned(spec, number, epoch, fence))

    @rule(ago=st.sampled_from([0.0, 0.0, 0.05, 3.0]))
    def hear(self, ago) -> None:
        self.heard_at = max(self.heard_at, self.now - ago)
        self.feed(ContactConfirmed(self.now - ago))

    @rule(spec=SPECS, number=NUMBERS)
    def fence(self, spec, number) -> None:
        self.feed(FenceOrdered(InstanceId(spec.name, number)))

    @rule(epoch=st.integers(1, 3))
    def register(self, epoch) -> None:
        self.feed(Registered(epoch))

    @rule(spec=SPECS, number=NUMBERS)
    def stop(self, spec, number) -> None:
        self.feed(StopOrdered(InstanceId(spec.name, number)))

    @rule(spec=SPECS, number=NUMBERS)
    def restart(self, spec, number) -> None:
        self.feed(RestartOrdered(InstanceId(spec.name, number)))

    @rule(spec=SPECS, number=NUMBERS, restart=st.sampled_from([NEVER, ON_FAILURE]))
    def set_restart(self, spec, number, restart) -> None:
        instance = InstanceId(spec.name, number)
        self.unsettled.add((instance, restart))
        self.feed(RestartPolicySet(instance, restart))

    @precondition(lambda self: self.amending)
    @rule()
    def record(self) -> None:
        self.feed(RestartPolicyRecorded(*self.amending.pop(0)))

    @rule(hears=st.booleans())
    def replace_supervisor(self, hears) -> None:
        """Replace the supervisor: unread orders are lost, its record is kept."""
        if not hears:
            self.amending.clear()
        found = (InstanceStatus(one, state, 7) for one, state in self.alive.items())
        ended = (h.status for h in self.state.held.values() if h.status.state.ended)
        self.feed(SupervisorReplaced((*found, *ended)))

    @rule(spec=SPECS, number=NUMBERS)
    def see(self, spec, number) -> None:
        self.feed(SeenInGraph(InstanceId(spec.name, number)))

    @rule(number=NUMBERS, pid=st.sampled_from([7, 7, 7, 8]), runs=st.booleans())
    def look(self, number, pid, runs) -> None:
        """Report unhealthy looks at the present or another run for longer than is allowed."""
        instance = InstanceId(WATCHED.name, number)
        if runs and instance in self.alive:
            self.alive[instance] = STATE.RUNNING
            self.feed(SupervisorReported((InstanceStatus(instance, STATE.RUNNING, 7),)))
        for _ in range(5):
            self.now += LOOK_PERIOD
            self.feed(LookedAt(instance, pid, Observation(stopped=True)))

    @rule(seconds=st.sampled_from([0.1, 5.0, 11.0, 61.0]))
    def wait(self, seconds) -> None:
        self.now += seconds
        self.feed(TimePassed())

    @rule()
    def report(self) -> None:
        self.feed(ReportRequested())

    @precondition(lambda self: self.alive)
    @rule(data=st.data(), state=st.sampled_from(InstanceState))
    def supervise(self, data, state) -> None:
        if state is STATE.READY:
            return
        instance = data.draw(st.sampled_from(sorted(self.alive)))
        if state.ended:
            del self.alive[instance]
        else:
            self.alive[instance] = state
        pid = 7 if state in (STATE.RUNNING, STATE.STOPPING) else 0
        self.feed(SupervisorReported((InstanceStatus(instance, state, pid),)))

    @invariant()
    def nothing_is_launched_twice(self) -> None:
        assert len(self.launched) == len(set(self.launched))

    @invariant()
    def what_lives_is_held(self) -> None:
        held = {i for i, h in self.state.held.items() if not h.status.state.ended}
        assert held == set(self.alive)
        assert self.state.live() == len(self.alive)

    @invariant()
    def the_master_knows(self) -> None:
        """Check that the last report of each instance, if it started, has its state."""
        for instance, held in self.state.held.items():
            known = self.reported.get(instance, STATE.STARTING)
            assert known is held.status.state

    @invariant()
    def every_order_is_or_will_be_settled(self) -> None:
        wanted = {(i, restart) for i, h in self.state.held.items() for restart in h.unsettled}
        assert self.unsettled <= wanted | set(self.amending)

    @invariant()
    def only_ready_ones_are_watched(self) -> None:
        for held in self.state.watched().values():
            assert held.status.state is STATE.READY
            assert held.status.pid

    @invariant()
    def only_running_ones_are_awaited(self) -> None:
        for held in self.state.awaited_in_graph().values():
            assert held.status.state is STATE.RUNNING
            assert held.status.pid


TestAnySlave = AnySlave.TestCase
TestAnySlave.settings = settings(max_examples=150, stateful_step_count=40, deadline=None)
