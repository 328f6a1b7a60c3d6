"""Lifecycle nodes that the slave configures and activates after each start and restart."""

from __future__ import annotations

import pytest

from rosrm.core.slave.commands import (
    ChangeLifecycleState,
    Fail,
    ReadLifecycleState,
    Remember,
    Report,
    SettleLifecycle,
)
from rosrm.core.slave.events import (
    LifecycleOrdered,
    LifecycleStateRead,
    SeenInGraph,
    SupervisorReplaced,
    TimePassed,
    TransitionAnswered,
)
from rosrm.core.slave.lifecycle_nodes import READ_PERIOD
from rosrm.core.slave.watches import Memo
from rosrm.model.values import (
    Health,
    InstanceId,
    InstanceState,
    InstanceStatus,
    LifecyclePolicy,
    ProcessSpec,
    Readiness,
)
from rosrm.slave.memos import from_memo, to_memo
from tests.unit.slave.rig import Slave, launched, states

N = InstanceId("n", 1)
PID = 5


def spec(goal="active", **more) -> ProcessSpec:
    return ProcessSpec(
        "n", module="m", ros=True, namespace="/robot", readiness=Readiness(timeout=10.0),
        lifecycle=LifecyclePolicy(goal, 3.0), **more,
    )  # fmt: skip


def seen(process=None, **more) -> Slave:
    """Return a slave whose node has just appeared in the graph."""
    slave = Slave(**more)
    slave.assign(process or spec())
    slave.status(InstanceState.RUNNING, "n")
    (request,) = slave.step(SeenInGraph(N))
    assert isinstance(request, ReadLifecycleState)
    return slave


def read(slave: Slave, label: str, **more):
    """Let the node report a state; return the commands, without requests for the state."""
    return slave.step(LifecycleStateRead(N, PID, label, slave.now), **more)


def answered(slave: Slave, transition: str, *, succeeded: bool = True):
    return slave.step(TransitionAnswered(N, PID, transition, succeeded))


def transitions(given) -> list[str]:
    """Return the transitions that the commands request."""
    return [one.transition for one in given if isinstance(one, ChangeLifecycleState)]


def fault(given) -> str:
    """Return why a `Fail`, the only one, ends the run."""
    (failed,) = [one for one in given if isinstance(one, Fail)]
    assert (failed.pid, failed.kill) == (PID, False)
    return failed.reason


def test_a_node_is_ready_when_it_is_active() -> None:
    """The slave configures the node, then activates it, then reports it ready."""
    slave = seen()
    assert transitions(read(slave, "unconfigured")) == ["configure"]
    assert transitions(answered(slave, "configure")) == ["activate"]
    assert slave.of("n").status.state is InstanceState.RUNNING
    assert states(answered(slave, "activate")) == [InstanceState.READY]


def test_a_node_is_ready_when_it_is_inactive_if_that_is_its_goal() -> None:
    """`autostart: inactive` only configures the node."""
    slave = seen(spec("inactive"))
    assert transitions(read(slave, "unconfigured")) == ["configure"]
    assert states(answered(slave, "configure")) == [InstanceState.READY]


@pytest.mark.parametrize(
    ("found", "goal", "next_one"),
    [
        ("active", "active", None),
        ("inactive", "active", "activate"),
        ("inactive", "inactive", None),
        ("active", "inactive", "deactivate"),
    ],
)
def test_the_state_of_the_node_decides(found, goal, next_one) -> None:
    """A node that has made transitions itself is not asked for those again."""
    commands = read(seen(spec(goal)), found)
    assert transitions(commands) == ([next_one] if next_one else [])
    assert states(commands) == ([] if next_one else [InstanceState.READY])


def test_an_unmanaged_node_is_ready_when_it_is_in_the_graph() -> None:
    """By default the slave does not touch the lifecycle."""
    slave = Slave()
    slave.assign(spec("unmanaged"))
    slave.status(InstanceState.RUNNING, "n")
    assert states(slave.step(SeenInGraph(N))) == [InstanceState.READY]


def test_services_are_those_of_the_node() -> None:
    """Namespace, node name and remappings of the spec apply."""
    slave = Slave()
    slave.assign(spec(remappings={"~/change_state": "~/own/change_state"}), alias="x")
    lifecycle = slave.of("n").lifecycle
    assert lifecycle is not None
    assert lifecycle.get_state == "/robot/x/get_state"
    assert lifecycle.change_state == "/robot/x/own/change_state"


# --- failures ---------------------------------------------------------------------------------


def test_a_transition_that_fails_ends_the_run() -> None:
    """The reason names the transition and the state before it; the restart policy applies."""
    slave = seen()
    read(slave, "unconfigured")
    assert fault(answered(slave, "configure", succeeded=False)) == (
        "not ready: the lifecycle transition configure from the state unconfigured failed in the "
        "node"
    )
    assert slave.step(TimePassed(), after=100.0) == []


def test_a_transition_that_hangs_ends_the_run() -> None:
    """Each transition has the time-out for itself."""
    slave = seen()
    read(slave, "unconfigured", after=2.0)
    answered(slave, "configure")
    slave.step(TimePassed(), after=2.9)
    assert fault(slave.step(TimePassed(), after=0.1)) == (
        "not ready: the lifecycle transition activate took longer than 3 s"
    )


def test_a_node_without_an_answer_ends_the_run() -> None:
    """The reason has the name of the service, as for a node that is no lifecycle node."""
    slave = seen()
    reason = fault(slave.step(TimePassed(), after=3.0))
    assert reason == "not ready: no answer from /robot/n/get_state within 3 s"


def test_a_finalized_node_ends_the_run() -> None:
    """No transition leaves that state."""
    assert "lifecycle state is finalized; active is required" in fault(read(seen(), "finalized"))


def test_a_node_that_stays_in_its_own_transition_ends_the_run() -> None:
    """The slave waits for the end of a transition that it did not request."""
    slave = seen()
    assert read(slave, "configuring") == []
    reason = fault(slave.step(TimePassed(), after=3.0))
    assert reason.endswith("its lifecycle state was configuring for 3 s; active is required")


# --- lost and late answers --------------------------------------------------------------------


def test_the_state_is_read_again_until_the_node_answers() -> None:
    """Discovery of the service, or an answer, may take time."""
    slave = seen()
    assert slave.step(TimePassed(), after=READ_PERIOD / 2) == []
    (again,) = slave.step(TimePassed(), after=READ_PERIOD)
    assert isinstance(again, ReadLifecycleState)
    assert again.at == slave.now


def test_a_lost_answer_to_a_transition_is_replaced_by_the_state() -> None:
    """A second request for the transition would be refused, so the slave reads the state."""
    slave = seen()
    read(slave, "unconfigured")
    assert read(slave, "unconfigured") == []
    assert read(slave, "configuring") == []
    assert transitions(read(slave, "inactive")) == ["activate"]
    assert answered(slave, "configure") == []


def test_answers_of_a_former_run_or_from_before_the_start_are_ignored() -> None:
    """They would cause a transition that the node cannot make."""
    slave = seen()
    assert slave.step(LifecycleStateRead(N, PID + 1, "active", slave.now)) == []
    assert slave.step(LifecycleStateRead(N, PID, "active", slave.now - 0.1)) == []
    assert slave.step(LifecycleStateRead(InstanceId("n", 2), PID, "active", slave.now)) == []


# --- further runs -----------------------------------------------------------------------------


def test_each_run_is_activated_again() -> None:
    """After a crash and restart the new node is unconfigured."""
    slave = seen()
    read(slave, "active")
    slave.status(InstanceState.BACKOFF, "n")
    slave.status(InstanceState.RUNNING, "n", pid=6)
    (request,) = slave.step(SeenInGraph(N))
    assert isinstance(request, ReadLifecycleState)
    assert request.pid == 6


def test_a_restored_node_is_managed_from_its_second_run_on() -> None:
    """The first run is in the state in which it was frozen; a later one starts unconfigured."""
    slave = Slave()
    slave.assign(spec(), restored=True)
    stored = slave.of("n").memo
    assert states(slave.status(InstanceState.RUNNING, "n")) == [InstanceState.READY]
    assert re_adopted(stored).of("n").status.state is InstanceState.READY
    slave.status(InstanceState.BACKOFF, "n")
    assert states(slave.status(InstanceState.RUNNING, "n", pid=6)) == [InstanceState.RUNNING]
    (request,) = slave.step(SeenInGraph(N))
    assert isinstance(request, ReadLifecycleState)


def test_a_slave_does_not_take_a_second_run_for_the_restored_one() -> None:
    """The process was restarted while no slave ran; the number of restarts shows it."""
    slave = Slave()
    slave.assign(spec(), restored=True)
    later = re_adopted(slave.of("n").memo, restarts=1)
    assert later.of("n").status.state is InstanceState.RUNNING
    (request,) = later.step(SeenInGraph(N))
    assert isinstance(request, ReadLifecycleState)


def test_the_next_slave_goes_on_where_the_node_is() -> None:
    """The memo has the goal; a node that was ready stays ready."""
    slave = seen()
    commands = read(slave, "active")
    (memo,) = [one.memo for one in commands if isinstance(one, Remember)]
    before = seen().of("n").memo
    assert re_adopted(before).of("n").status.state is InstanceState.RUNNING
    assert re_adopted(memo).of("n").status.state is InstanceState.READY
    later = re_adopted(before)
    later.step(SeenInGraph(N))
    assert transitions(read(later, "inactive")) == ["activate"]


def re_adopted(memo: Memo, restarts: int = 0) -> Slave:
    """Return a later run of the slave that re-adopts the node from the supervisor."""
    later = Slave()
    stored = from_memo(to_memo(memo))
    assert stored is not None
    status = InstanceStatus(N, InstanceState.RUNNING, PID, restarts=restarts)
    later.step(SupervisorReplaced((status,), {N: stored}))
    return later


def test_a_repeated_report_of_the_run_changes_nothing() -> None:
    """A new supervisor reports all runs; the transition under way continues."""
    slave = seen()
    read(slave, "unconfigured")
    held = slave.of("n")
    memos = {held.status.instance: held.memo}
    commands = slave.step(SupervisorReplaced((held.status,), memos))
    assert not [one for one in commands if not isinstance(one, Report)]
    assert transitions(answered(slave, "configure")) == ["activate"]


def test_a_node_on_the_way_counts_as_starting() -> None:
    """`max_starting` bounds the load of configurations as that of starts."""
    slave = seen(max_starting=1)
    slave.assign(spec(), number=2)
    assert "max_starting" in slave.of("n", 2).status.message
    assert launched(read(slave, "active")) == [InstanceId("n", 2)]


# --- orders of the master ---------------------------------------------------------------------


def answers(given) -> list[tuple[str, str]]:
    """Return goal and refusal of each answered order."""
    return [(one.goal, one.refusal) for one in given if isinstance(one, SettleLifecycle)]


def active(process=None) -> Slave:
    """Return a slave whose node is active."""
    slave = seen(process)
    read(slave, "active")
    return slave


def test_an_order_is_answered_when_the_node_has_reached_the_state() -> None:
    """The node stays ready; the memo has the goal, so that a restarted node is only configured."""
    slave = active()
    commands = slave.step(LifecycleOrdered(N, "inactive"))
    assert [type(one) for one in commands] == [Remember, ReadLifecycleState]
    assert transitions(read(slave, "active")) == ["deactivate"]
    assert answers(answered(slave, "deactivate")) == [("inactive", "")]
    assert slave.of("n").status.state is InstanceState.READY
    slave.status(InstanceState.BACKOFF, "n")
    slave.status(InstanceState.RUNNING, "n", pid=6)
    slave.step(SeenInGraph(N))
    slave.step(LifecycleStateRead(N, 6, "unconfigured", slave.now))
    configured = slave.step(TransitionAnswered(N, 6, "configure", succeeded=True))
    assert states(configured) == [InstanceState.READY]


def test_the_destination_of_a_move_is_activated_by_an_order() -> None:
    """The destination is ready when it is inactive, although its spec requires `active`."""
    slave = Slave()
    slave.assign(spec(), inactive=True)
    slave.status(InstanceState.RUNNING, "n")
    slave.step(SeenInGraph(N))
    assert states(read(slave, "inactive")) == [InstanceState.READY]
    slave.step(LifecycleOrdered(N, "active"))
    assert transitions(read(slave, "inactive")) == ["activate"]
    assert answers(answered(slave, "activate")) == [("active", "")]


def test_a_repeated_order_is_answered_once_and_again() -> None:
    """One command answers all repetitions that wait; a later repetition has its own answer."""
    slave = active()
    slave.step(LifecycleOrdered(N, "inactive"))
    read(slave, "active")
    assert slave.step(LifecycleOrdered(N, "inactive")) == []
    assert answers(answered(slave, "deactivate")) == [("inactive", "")]
    slave.step(LifecycleOrdered(N, "inactive"))
    assert answers(read(slave, "inactive")) == [("inactive", "")]


def test_a_source_that_cannot_be_deactivated_keeps_running() -> None:
    """The order is refused with the reason, and the master undoes the move."""
    slave = active()
    slave.step(LifecycleOrdered(N, "inactive"))
    read(slave, "active")
    commands = answered(slave, "deactivate", succeeded=False)
    reason = "the lifecycle transition deactivate from the state active failed in the node"
    assert commands == [SettleLifecycle(N, "inactive", reason)]


def test_a_node_that_cannot_be_activated_has_failed() -> None:
    """The restart policy applies: a source on the way back is started again, and activated."""
    slave = active()
    slave.step(LifecycleOrdered(N, "active"))
    read(slave, "inactive")
    commands = answered(slave, "activate", succeeded=False)
    reason = "the lifecycle transition activate from the state inactive failed in the node"
    assert answers(commands) == [("active", reason)]
    assert fault(commands) == f"not active: {reason}"


def test_an_order_is_refused_if_the_slave_does_not_manage_the_node() -> None:
    """The same holds for an instance that is unknown or has ended."""
    slave = Slave()
    slave.assign(spec("unmanaged"))
    assert answers(slave.step(LifecycleOrdered(N, "active")))[0][1]
    assert answers(slave.step(LifecycleOrdered(InstanceId("x", 1), "active")))[0][1]


def test_an_order_to_an_instance_that_ends_is_refused() -> None:
    """Otherwise the answer would never be sent."""
    slave = active()
    slave.step(LifecycleOrdered(N, "inactive"))
    slave.status(InstanceState.EXITED, "n")
    assert answers(slave.step(TimePassed())) == [("inactive", "it has ended")]
    assert answers(slave.step(TimePassed())) == []


def test_another_goal_replaces_the_former_order() -> None:
    """On the way back the source is activated although its deactivation is under way."""
    slave = active()
    slave.step(LifecycleOrdered(N, "inactive"))
    read(slave, "active")
    commands = slave.step(LifecycleOrdered(N, "active"))
    assert answers(commands) == [("inactive", "another state was ordered")]
    assert transitions(answered(slave, "deactivate")) == ["activate"]
    assert answers(answered(slave, "activate")) == [("active", "")]


def test_health_is_not_checked_while_an_order_keeps_the_node_inactive() -> None:
    """An inactive node may be silent."""
    slave = active(spec(health=Health("scan", 1.0, "active", 2.0)))
    assert slave.state.watched()
    slave.step(LifecycleOrdered(N, "inactive"))
    assert not slave.state.watched()
    slave.step(LifecycleOrdered(N, "active"))
    assert slave.state.watched()
