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
from rosrm.core.slave.commands import Amend, Launch, Remember, Report, Settle, Stop
from rosrm.core.slave.events import (
    AmendmentOrdered,
    AmendmentRecorded,
    AssignmentsReceived,
    ContactConfirmed,
    FenceOrdered,
    LaunchRefused,
    LifecycleStateRead,
    LookedAt,
    MasterLost,
    Registered,
    ReportRequested,
    RestartOrdered,
    SeenInGraph,
    Slept,
    StartDelayed,
    StopOrdered,
    SupervisorReplaced,
    SupervisorReported,
    TimePassed,
    TransitionAnswered,
)
from rosrm.core.slave.handlers import REMEMBER_END, REPORT_WAIT
from rosrm.core.slave.health import LOOK_PERIOD
from rosrm.core.slave.state import SlaveState, under_limits
from rosrm.core.slave.watches import Memo, Observation
from rosrm.model.orders import ENDED
from rosrm.model.values import (
    Amendment,
    Fence,
    Health,
    InstanceId,
    InstanceState,
    InstanceStatus,
    LifecyclePolicy,
    Limits,
    ProcessSpec,
    Readiness,
    RestartPolicy,
    Run,
)
from rosrm.slave.memos import from_memo, to_memo
from tests.unit.slave.rig import PLAIN, Slave, assignment, launched, states

NODE = ProcessSpec("n", module="m", ros=True, namespace="/robot", readiness=Readiness(timeout=10.0))
STATE = InstanceState
ONE = InstanceId("p", 1)
NODE_1 = InstanceId("n", 1)
NEVER = Amendment(RestartPolicy("never"))
ON_FAILURE = Amendment(RestartPolicy("on-failure"))


@pytest.fixture
def one() -> Slave:
    """Return a slave without an instance."""
    return Slave()


@pytest.fixture
def running(one) -> Slave:
    """Return a slave with one running instance."""
    one.assign()
    one.status(STATE.RUNNING)
    return one


@pytest.fixture
def node(one) -> Slave:
    """Return a slave with a running node, which it awaits in the graph."""
    one.assign(NODE)
    one.status(STATE.RUNNING, "n")
    return one


def awaited_names(one: Slave) -> list[str]:
    """Return the names of the nodes that the slave awaits in the graph."""
    return [h.awaited.node_name for h in one.state.awaited_in_graph().values()]


def replaced(*statuses, **more) -> SupervisorReplaced:
    """Return the arrival of a supervisor that manages these instances."""
    return SupervisorReplaced(statuses, **more)


RUNS = replaced(InstanceStatus(ONE, STATE.RUNNING, pid=5))

# --- assignments ------------------------------------------------------------------------------


def test_an_assignment_is_launched_once(one) -> None:
    """A repeated order starts nothing, before and after the end of the instance."""
    assert [type(c) for c in one.assign()] == [Launch]
    assert one.assign() == []
    one.status(STATE.RUNNING)
    one.status(STATE.EXITED)
    assert one.assign() == []


def test_a_refused_launch_is_reported(one) -> None:
    """The reason reaches the master."""
    one.assign()
    (report,) = one.step(LaunchRefused(ONE, "no such package"))
    (status,) = report.statuses
    assert (status.state, status.message) == (STATE.REFUSED, "no such package")


def test_a_delayed_start_is_reported_until_the_instance_runs(one) -> None:
    """The master shows the reason; a late report changes nothing."""
    one.assign()
    (report,) = one.step(StartDelayed(ONE, "fetches artifacts"))
    (status,) = report.statuses
    assert (status.state, status.message) == (STATE.STARTING, "fetches artifacts")
    one.status(STATE.RUNNING)
    assert one.step(StartDelayed(ONE, "fetches artifacts")) == []


def test_an_instance_lost_with_its_supervisor_cannot_be_refused_any_more(one) -> None:
    """The instance was starting when its supervisor was killed: no supervisor holds it."""
    one.assign()
    one.step(replaced())
    assert one.step(LaunchRefused(ONE, "no such package")) == []


def test_what_the_supervisor_lost_at_once_is_not_launched(one) -> None:
    """An assignment and the next supervisor in one batch start nothing.

    The next supervisor does not know the instance. The master repeats the assignment and receives
    the refusal.
    """
    batch = [AssignmentsReceived((assignment(),)), replaced()]
    assert launched(reducer.step_all(one.state, batch, one.now)) == []
    assert states(one.assign(after=2.0)) == [STATE.REFUSED]


def test_an_older_epoch_starts_nothing(one) -> None:
    """The refusal names both epochs; a newer master may still use the instance's number."""
    one.step(Registered(3))
    assert states(one.assign(epoch=2, number=8)) == [STATE.REFUSED]
    assert "epoch 2" in one.of(number=8).status.message
    assert launched(one.assign(epoch=3, number=9)) == [InstanceId("p", 9)]


def test_stopped_before_it_was_started(one) -> None:
    """A stop that overtakes its start wins: a later start is refused for good."""
    assert states(one.step(StopOrdered(ONE))) == [STATE.REFUSED]
    assert one.assign() == []
    one.step(TimePassed(), after=REMEMBER_END)
    assert states(one.assign()) == [STATE.REFUSED]


@pytest.mark.parametrize("end", ["refused", "exited"])
def test_a_dead_number_stays_dead(one, end) -> None:
    """A late order of the same instance starts nothing, even after its end was forgotten."""
    one.assign()
    if end == "refused":
        one.step(LaunchRefused(ONE, "no such package"))
    else:
        one.status(STATE.EXITED)
    assert one.step(TimePassed(), after=REMEMBER_END) == [slave_commands.Forget((ONE,))]
    assert states(one.assign()) == [STATE.REFUSED]
    assert launched(one.assign(number=2)) == [InstanceId("p", 2)]


def test_dead_numbers_are_given_again_by_a_master_that_has_lost_its_journal(one) -> None:
    """A master without journal begins at epoch 1 and may reuse numbers; any other may not."""
    one.step(StopOrdered(ONE))
    one.step(Registered(7))
    one.step(TimePassed(), after=REMEMBER_END)
    assert states(one.assign(epoch=7)) == [STATE.REFUSED]
    one.step(Registered(1, renumbers=True))
    one.step(TimePassed(), after=REMEMBER_END)
    assert launched(one.assign(epoch=1)) == [ONE]


def test_an_end_is_kept_until_a_master_knows_it(one) -> None:
    """The slave keeps the end of a job until a master has learned it, however long that takes."""
    one.assign()
    one.step(MasterLost())
    one.status(STATE.EXITED)
    assert one.step(TimePassed(), after=10 * REMEMBER_END) == []
    one.step(Registered(2))
    assert one.step(TimePassed(), after=REMEMBER_END / 2) == []
    assert len(one.step(TimePassed(), after=REMEMBER_END)) == 1


# --- reports ----------------------------------------------------------------------------------


def test_a_change_during_the_registration_is_reported(running) -> None:
    """The registration request had the older status; without a change it needs no report."""
    running.step(MasterLost())
    assert running.step(Registered(1)) == []
    running.step(MasterLost())
    running.status(STATE.FAILED)
    (report,) = running.step(Registered(2))
    assert (states([report]), report.complete) == ([STATE.FAILED], False)


def test_a_complete_report_names_everything(one) -> None:
    """The report includes ended instances that are still remembered."""
    one.assign()
    one.assign(number=2)
    one.status(STATE.EXITED)
    (report,) = one.step(ReportRequested())
    assert report.complete
    found = {s.instance.number: s.state for s in report.statuses}
    assert found == {1: STATE.EXITED, 2: STATE.STARTING}


def test_stop_and_restart_go_to_the_supervisor(running) -> None:
    """An ended instance is reported again; a restart of an unknown one has no effect."""
    assert running.step(RestartOrdered(ONE)) == [slave_commands.Restart(ONE)]
    assert running.step(StopOrdered(ONE)) == [Stop(ONE)]
    running.status(STATE.EXITED)
    assert states(running.step(StopOrdered(ONE))) == [STATE.EXITED]
    assert states(running.step(RestartOrdered(ONE))) == [STATE.EXITED]
    assert running.step(RestartOrdered(InstanceId("q", 2))) == []


def test_a_late_order_to_restart_a_former_run_changes_nothing(running) -> None:
    """The slave answers with the status, which shows the present run."""
    running.status(STATE.RUNNING, pid=6)
    assert states(running.step(RestartOrdered(ONE, Run(5, 0)))) == [STATE.READY]
    meant = Run(6, 0)
    assert running.step(RestartOrdered(ONE, meant)) == [slave_commands.Restart(ONE, meant)]


# --- readiness --------------------------------------------------------------------------------


def test_a_process_is_ready_as_soon_as_it_runs(one) -> None:
    """Only ROS nodes need more than a running process."""
    one.assign()
    assert states(one.status(STATE.RUNNING)) == [STATE.READY]
    assert one.status(STATE.RUNNING) == []


@pytest.mark.parametrize(
    ("shadow", "name"),
    [({}, "/robot/n"), ({"alias": "n_17", "shadow": True}, "/robot/n_17")],
    ids=["node", "shadow"],
)
def test_a_node_is_ready_when_it_is_seen(one, shadow, name) -> None:
    """The slave awaits the qualified name, a shadow's alias, and reports the node ready once."""
    one.assign(NODE, **shadow)
    assert awaited_names(one) == []
    assert states(one.status(STATE.RUNNING, "n")) == [STATE.RUNNING]
    assert awaited_names(one) == [name]
    assert states(one.step(SeenInGraph(NODE_1))) == [STATE.READY]
    assert one.step(SeenInGraph(NODE_1)) == []
    assert awaited_names(one) == []


def test_readiness_kinds() -> None:
    """`running` makes a node ready at once; with `graph` the slave awaits any process."""
    assert not replace(NODE, readiness=Readiness("running")).awaits_graph
    assert replace(PLAIN, readiness=Readiness("graph")).awaits_graph
    assert NODE.awaits_graph
    assert not PLAIN.awaits_graph


def test_an_instance_that_does_not_become_ready_is_stopped_and_has_failed(node) -> None:
    """The time-out is the reason, whatever the exit code."""
    assert node.step(TimePassed(), after=9.9) == []
    assert node.step(TimePassed(), after=0.2) == [Stop(NODE_1)]
    assert node.step(TimePassed(), after=1.0) == []
    assert states(node.status(STATE.STOPPING, "n")) == [STATE.STOPPING]
    (report,) = node.status(STATE.EXITED, "n")
    assert states([report]) == [STATE.FAILED]
    assert "not ready within 10 s" in report.statuses[0].message
    assert "/robot/n" in report.statuses[0].message


def test_a_suspend_of_the_machine_prolongs_the_time_to_be_ready(node) -> None:
    """The node did nothing in that time; at the resume it has what is left of its 10 s."""
    assert node.step(TimePassed(), after=4.0) == []
    assert node.step(Slept(3600.0), after=3600.0) == []
    assert node.step(TimePassed(), after=5.9) == []
    assert node.step(TimePassed(), after=0.2) == [Stop(NODE_1)]


def test_a_run_that_is_ready_after_all_does_not_fail_for_its_late_readiness(node) -> None:
    """The supervisor was killed before it got the order to stop the node."""
    node.step(TimePassed(), after=10.1)
    node.step(replaced(InstanceStatus(NODE_1, STATE.RUNNING, pid=5)))
    assert states(node.step(SeenInGraph(NODE_1))) == [STATE.READY]
    assert states(node.status(STATE.EXITED, "n")) == [STATE.EXITED]


def test_each_run_has_its_own_time_to_become_ready(node) -> None:
    """After a crash and restart the node must appear in the graph again."""
    node.step(SeenInGraph(NODE_1))
    assert states(node.status(STATE.BACKOFF, "n", after=60.0)) == [STATE.BACKOFF]
    assert awaited_names(node) == []
    assert states(node.status(STATE.STARTING, "n")) == [STATE.STARTING]
    assert states(node.status(STATE.RUNNING, "n", pid=6)) == [STATE.RUNNING]
    assert node.step(TimePassed(), after=9.0) == []
    assert states(node.step(SeenInGraph(NODE_1))) == [STATE.READY]


def test_an_instance_of_a_former_run_of_the_slave_is_ready(one) -> None:
    """The slave lost the spec, but the process runs and keeps running."""
    assert states(one.status(STATE.RUNNING, "n")) == [STATE.READY]
    assert one.step(TimePassed(), after=1000.0) == []
    assert one.assign(NODE) == []


# --- a later run of the slave -----------------------------------------------------------------


def test_facts_that_a_killed_supervisor_has_not_stored_are_stored_again(node) -> None:
    """Otherwise a later run of the slave would wait for the node again."""
    (remember,) = [
        one for one in node.step(SeenInGraph(NODE_1)) if isinstance(one, slave_commands.Remember)
    ]
    runs = InstanceStatus(NODE_1, STATE.RUNNING, pid=5)
    assert remember in node.step(replaced(runs))
    assert remember not in node.step(replaced(runs, memos={NODE_1: remember.memo}))


def re_adopted(one: Slave, memo: Memo | None, pid: int = 5) -> Slave:
    """Return a later run of the slave that re-adopts the node from the supervisor."""
    later = Slave(one.now)
    written = from_memo(to_memo(memo))
    later.step(replaced(InstanceStatus(NODE_1, STATE.RUNNING, pid), memos={NODE_1: written}))
    return later


def test_a_node_that_was_still_awaited_is_awaited_by_the_next_slave(one) -> None:
    """The next slave waits for the node, whose first slave was killed before the node was ready."""
    one.assign(NODE)
    later = re_adopted(one, one.of("n").memo)
    assert later.of("n").status.state is STATE.RUNNING
    assert awaited_names(later) == ["/robot/n"]
    assert later.step(TimePassed(), after=9.9) == []
    assert later.step(TimePassed(), after=0.2) == [Stop(NODE_1)]


def test_a_node_that_was_seen_is_ready_for_the_next_slave(node) -> None:
    """Readiness holds for the run that was seen; the next run must appear in the graph again."""
    (memo,) = [c.memo for c in node.step(SeenInGraph(NODE_1)) if isinstance(c, Remember)]
    later = re_adopted(node, memo)
    assert later.of("n").status.state is STATE.READY
    assert later.step(TimePassed(), after=1000.0) == []
    later.status(STATE.BACKOFF, "n")
    assert states(later.status(STATE.RUNNING, "n", pid=6)) == [STATE.RUNNING]
    assert awaited_names(later) == ["/robot/n"]
    assert re_adopted(node, memo, pid=6).of("n").status.state is STATE.RUNNING


MEMO = '{"awaited": ["/n", "soon", 0], "watch": null}'


@pytest.mark.parametrize("memo", ["", "{}", "[1]", "nothing", '["/n", 1.0, 0]', MEMO])
def test_a_memo_of_another_version_is_none(memo) -> None:
    """A memo of an unknown version is ignored."""
    assert from_memo(memo) is None


# --- amendments -------------------------------------------------------------------


def test_an_amendment_is_settled_when_it_is_recorded(running) -> None:
    """Each repeated order is acknowledged, with the instance's status."""
    for _ in range(2):
        assert running.step(AmendmentOrdered(ONE, NEVER)) == [Amend(ONE, NEVER)]
        report, settled = running.step(AmendmentRecorded(ONE, NEVER))
        assert states([report]) == [STATE.READY]
        assert settled == Settle(ONE, NEVER)


def test_an_amendment_of_a_re_adopted_instance(one) -> None:
    """The slave lost its spec, but the supervisor has all that is needed."""
    one.step(RUNS)
    assert one.step(AmendmentOrdered(ONE, NEVER)) == [Amend(ONE, NEVER)]


def test_an_older_amendment_that_is_recorded_does_not_settle_a_newer_one(running) -> None:
    """Each order in progress has its own answer, if need be from the next supervisor.

    The killed supervisor may have recorded the newer one or not; the next one's answer counts.
    """
    running.step(AmendmentOrdered(ONE, NEVER))
    running.step(AmendmentOrdered(ONE, ON_FAILURE))
    assert running.step(AmendmentRecorded(ONE, NEVER))[-1] == Settle(ONE, NEVER)
    assert running.step(RUNS)[:-1] == [Amend(ONE, ON_FAILURE)]
    running.step(AmendmentRecorded(ONE, ON_FAILURE))
    assert [type(c) for c in running.step(RUNS)] == [Report]


def test_an_amendment_of_an_ended_instance_reports_its_end(running) -> None:
    """The order is refused, because it has no effect; the same holds for an end in between."""
    refused = Settle(ONE, NEVER, "p#1 has ended", ENDED)
    running.step(AmendmentOrdered(ONE, NEVER))
    running.status(STATE.FAILED)
    report, settled = running.step(AmendmentOrdered(ONE, NEVER))
    assert states([report]) == [STATE.FAILED]
    assert settled == refused
    ended = replaced(InstanceStatus(ONE, STATE.FAILED))
    assert refused in running.step(ended)
    assert running.step(AmendmentRecorded(ONE, NEVER))[-1] == refused


def test_an_amendment_of_an_unknown_instance_is_refused(running) -> None:
    """The order is refused also if only a killed supervisor could have known the instance."""
    (settled,) = running.step(AmendmentOrdered(InstanceId("q", 1), NEVER))
    assert "q#1 is not known here" in settled.refusal
    assert settled.code == "unknown"
    running.step(AmendmentOrdered(ONE, NEVER))
    settled = running.step(replaced())[0]
    assert isinstance(settled, Settle)
    assert settled.refusal


def test_an_amendment_of_a_held_instance(running) -> None:
    """The waiting instance starts with the new policy and limits, and not as a shadow."""
    running.state.max_processes = 1
    running.assign(number=2, alias="p_17", shadow=True)
    held = InstanceId("p", 2)
    amendment = replace(ON_FAILURE, limits=Limits(memory=2e9))
    _, settled = running.step(AmendmentOrdered(held, amendment))
    assert settled == Settle(held, amendment)
    (launch,) = [c for c in running.status(STATE.EXITED) if isinstance(c, Launch)]
    (started,) = launch.assignments
    assert Amendment(started.spec.restart, started.spec.limits) == amendment
    assert not started.shadow


def test_an_amendment_is_kept_for_a_start_that_still_waits_for_files(running) -> None:
    """The instance starts with the amendment; a later one without limits keeps the limits."""
    limited = replace(ON_FAILURE, limits=Limits(memory=2e9))
    running.step(AmendmentOrdered(ONE, limited))
    running.step(AmendmentOrdered(ONE, NEVER))
    assert running.state.held[ONE].amended == replace(NEVER, limits=Limits(memory=2e9))


def test_limits_that_change_while_an_instance_runs_are_reported(running) -> None:
    """The instance stays ready, and the master learns which limits hold now."""
    running.status(STATE.RUNNING, pid=7)
    ready = running.state.held[ONE].status
    limited = replace(ready, state=STATE.RUNNING, enforced=("limits.cpu",))
    assert running.step(SupervisorReported((limited,))) == [
        Report((replace(ready, enforced=("limits.cpu",)),))
    ]


def test_a_refusal_of_the_supervisor_settles_an_amendment(running) -> None:
    """The order is not repeated to the next supervisor."""
    running.step(AmendmentOrdered(ONE, NEVER))
    refused = running.step(AmendmentRecorded(ONE, NEVER, "it uses more"))
    assert refused[-1] == Settle(ONE, NEVER, "it uses more")
    assert [type(one) for one in running.step(RUNS)] == [Report]


def test_an_amendment_of_a_forgotten_instance_is_settled(running) -> None:
    """The supervisor never records it, but the master still receives an answer."""
    running.step(Registered(1))
    running.step(AmendmentOrdered(ONE, NEVER))
    running.status(STATE.EXITED)
    refused = Settle(ONE, NEVER, "p#1 has ended", ENDED)
    assert refused in running.step(TimePassed(), after=100.0)


# --- limits -----------------------------------------------------------------------------------


def nodes(count: int) -> AssignmentsReceived:
    return AssignmentsReceived(
        tuple(assignment(replace(NODE, name=f"n{number}")) for number in range(count))
    )


def test_at_most_max_starting_instances_start_at_a_time() -> None:
    """The others are held, and reported after `REPORT_WAIT`; the next starts once one is ready."""
    one = Slave(max_starting=2)
    assert launched(one.step(nodes(4))) == [InstanceId("n0", 1), InstanceId("n1", 1)]
    assert states(one.step(TimePassed(), after=REPORT_WAIT)) == [STATE.HELD, STATE.HELD]
    assert "max_starting: 2" in one.of("n2").status.message
    assert launched(one.status(STATE.RUNNING, "n0")) == []
    assert launched(one.step(SeenInGraph(InstanceId("n0", 1)))) == [InstanceId("n2", 1)]


def test_the_wait_of_a_repeated_assignment_is_reported_at_once() -> None:
    """The master repeats an assignment without a status, and would withdraw it later."""
    one = Slave(max_starting=1)
    assert states(one.step(nodes(2))) == []
    assert states(one.step(nodes(2))) == [STATE.HELD]


def test_an_instance_that_ends_before_it_is_ready_frees_its_slot() -> None:
    """An instance that is stopped because it is not ready in time frees its slot, too."""
    one = Slave(max_starting=1)
    one.step(nodes(3))
    assert launched(one.status(STATE.FAILED, "n0")) == [InstanceId("n1", 1)]
    one.status(STATE.RUNNING, "n1")
    assert Stop(InstanceId("n1", 1)) in one.step(TimePassed(), after=11.0)
    assert launched(one.status(STATE.STOPPING, "n1")) == [InstanceId("n2", 1)]


def test_a_plain_program_has_started_as_soon_as_it_runs() -> None:
    """A bound on starts hardly delays plain programs."""
    one = Slave(max_starting=1)
    one.assign()
    one.assign(replace(PLAIN, name="q"))
    assert launched(one.status(STATE.RUNNING)) == [InstanceId("q", 1)]


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


def test_a_memo_of_another_program_is_left_out() -> None:
    for text in ("", "{", '{"awaited": 1}', "[" * 100_000):
        assert from_memo(text or "null") is None


# --- any order of events ----------------------------------------------------------------------

NUMBERS = st.integers(1, 4)
WATCHED = ProcessSpec(
    "w", command=("true",), health=Health(timeout=0.5), restart=ON_FAILURE.restart
)
MANAGED = replace(NODE, name="m", lifecycle=LifecyclePolicy("active", 10.0))
SPECS = st.sampled_from([PLAIN, NODE, WATCHED, MANAGED])
LIFECYCLE_REQUESTS = (slave_commands.ReadLifecycleState, slave_commands.ChangeLifecycleState)
#: Transitions of a lifecycle node: states before and after.
TRANSITIONS = {"configure": ("unconfigured", "inactive"), "activate": ("inactive", "active")}
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
        self.contact_at = 0.0
        self.lifecycle_states: dict[InstanceId, str] = {}
        self.requests: list[slave_commands.Command] = []

    def feed(self, event) -> None:
        for command in reducer.step(self.state, event, self.now):
            if isinstance(command, slave_commands.Launch):
                for assignment in command.assignments:
                    self.check_fence(assignment)
                    self.launched.append(assignment.instance)
                    self.alive[assignment.instance] = STATE.STARTING
                    self.lifecycle_states[assignment.instance] = "unconfigured"
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
                assert command.instance in self.alive, "a change of what does not run"
                self.amending.append((command.instance, command.amendment))
            elif isinstance(command, slave_commands.Settle):
                self.unsettled.discard((command.instance, command.amendment))
            elif isinstance(command, LIFECYCLE_REQUESTS):
                self.request(command)
            elif isinstance(command, slave_commands.Forget):
                assert not self.alive.keys() & set(command.instances), "a live one forgotten"

    def request(self, command) -> None:
        if isinstance(command, slave_commands.ChangeLifecycleState):
            before, _ = TRANSITIONS[command.transition]
            found = self.lifecycle_states[command.instance]
            assert found == before, "a transition that ends a node of rclpy"
        self.requests.append(command)

    def check_fence(self, assignment) -> None:
        fence = assignment.fence
        late = fence is not None and self.now >= self.contact_at + fence.after
        assert not late or fence.alive, "started when its successor may run"

    @rule(spec=SPECS, number=NUMBERS, epoch=st.integers(1, 3), fence=FENCES)
    def assign(self, spec, number, epoch, fence) -> None:
        given = assignment(spec, number, epoch=epoch, fence=fence)
        self.feed(AssignmentsReceived((given,)))

    @rule(ago=st.sampled_from([0.0, 0.0, 0.05, 3.0]))
    def confirm_contact(self, ago) -> None:
        self.contact_at = max(self.contact_at, self.now - ago)
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

    @rule(spec=SPECS, number=NUMBERS, amendment=st.sampled_from([NEVER, ON_FAILURE]))
    def amend(self, spec, number, amendment) -> None:
        instance = InstanceId(spec.name, number)
        self.unsettled.add((instance, amendment))
        self.feed(AmendmentOrdered(instance, amendment))

    @precondition(lambda self: self.amending)
    @rule()
    def record(self) -> None:
        self.feed(AmendmentRecorded(*self.amending.pop(0)))

    @rule(reads=st.booleans())
    def replace_supervisor(self, reads) -> None:
        """Replace the supervisor: unread orders are lost, its record is kept."""
        if not reads:
            self.amending.clear()
        found = (InstanceStatus(one, state, 7) for one, state in self.alive.items())
        ended = (h.status for h in self.state.held.values() if h.status.state.ended)
        self.feed(SupervisorReplaced((*found, *ended)))

    @rule(spec=SPECS, number=NUMBERS)
    def see(self, spec, number) -> None:
        self.feed(SeenInGraph(InstanceId(spec.name, number)))

    @precondition(lambda self: self.requests)
    @rule(data=st.data(), is_lost=st.booleans())
    def answer(self, data, is_lost) -> None:
        """Let a lifecycle node handle one of the requests to it; the answer may be lost."""
        request = data.draw(st.sampled_from(self.requests))
        self.requests.remove(request)
        instance, pid = request.instance, request.pid
        if isinstance(request, slave_commands.ReadLifecycleState):
            event = LifecycleStateRead(instance, pid, self.lifecycle_states[instance], request.at)
        else:
            self.lifecycle_states[instance] = TRANSITIONS[request.transition][1]
            event = TransitionAnswered(instance, pid, request.transition, succeeded=True)
        if not is_lost:
            self.feed(event)

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
        if state is not STATE.RUNNING:
            self.lifecycle_states[instance] = "unconfigured"
            self.requests = [one for one in self.requests if one.instance != instance]
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
        pending = {(i, one) for i, h in self.state.held.items() for one in h.unsettled}
        assert self.unsettled <= pending | set(self.amending)

    @invariant()
    def only_ready_ones_are_watched(self) -> None:
        for held in self.state.watched().values():
            assert held.status.state is STATE.READY
            assert held.status.pid

    @invariant()
    def only_running_ones_are_steered(self) -> None:
        for held in self.state.held.values():
            if held.steering is not None:
                assert held.status.state in (STATE.RUNNING, STATE.READY)

    @invariant()
    def managed_nodes_are_active_when_they_are_ready(self) -> None:
        for instance, held in self.state.held.items():
            if held.lifecycle is not None and held.status.state is STATE.READY:
                assert self.lifecycle_states[instance] == "active"

    @invariant()
    def only_running_ones_are_awaited(self) -> None:
        for held in self.state.awaited_in_graph().values():
            assert held.status.state is STATE.RUNNING
            assert held.status.pid


TestAnySlave = AnySlave.TestCase
TestAnySlave.settings = settings(max_examples=150, stateful_step_count=40, deadline=None)
