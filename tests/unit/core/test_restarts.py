"""Restarts in place: a lost order is repeated, and only restarts the run for which it was meant."""

from __future__ import annotations

import pytest

from rosrm.core.master import events as happened
from rosrm.core.slave import events
from rosrm.model.orders import ReportInstances, RestartInstance
from rosrm.model.values import HostLossPolicy, InstanceState, InstanceStatus, RestartPolicy
from tests.unit.core.cluster import Cluster, job, movable, process
from tests.unit.core.test_start_order import follower


def lose_orders(cluster: Cluster, host: str = "a") -> None:
    """Lose the orders on their way to a host, and those that are given at once in their place."""
    machine = cluster.machines[host]
    for _ in range(3):
        while machine.ordered:
            cluster.tell(happened.OrderAnswered.missing(machine.ordered.popleft().order_id))


def restart_unreported(cluster: Cluster) -> None:
    """Restart a process, and lose the answer of the slave and the statuses of the restart."""
    cluster.ask(happened.RestartRequested, ("p",), settle=False)
    machine = cluster.machines["a"]
    machine.obey(machine.ordered.popleft(), cluster.now)
    machine.status_batches.clear()


def forget_order(cluster: Cluster) -> None:
    """Let a slave accept an order to restart, and be killed before its supervisor gets it."""
    machine = cluster.machines["a"]
    (sent,) = [one for one in machine.ordered if isinstance(one.order, RestartInstance)]
    machine.ordered.clear()
    cluster.tell(happened.OrderAnswered(sent.order_id, accepted=True))
    cluster.cut("a", seconds=2.0)
    cluster.restart_slave("a")


def test_a_restart_order_without_an_answer_is_repeated_until_the_run_has_changed() -> None:
    """The master repeats the order, and the process is restarted once."""
    cluster = Cluster("a").with_processes(process("p"))
    cluster.ask(happened.RestartRequested, ("p",), settle=False)
    lose_orders(cluster)
    assert cluster.runs("p") == 0
    cluster.wait(60.0)
    assert cluster.runs("p") == 1
    assert cluster.state.instances[cluster["p"].owner].restarting is None


def test_a_lost_report_of_a_restart_does_not_cause_another_restart() -> None:
    """The master asks for the missing report before it repeats the order."""
    cluster = Cluster("a").with_processes(process("p"))
    restart_unreported(cluster)
    cluster.wait(0.2)
    cluster.tell(happened.OrderAnswered.missing(cluster.sent(RestartInstance)[0].order_id))
    cluster.wait(60.0)
    assert cluster.runs("p") == 1
    assert cluster.state.instances[cluster["p"].owner].restarting is None


def test_an_accepted_restart_that_the_slave_forgets_is_ordered_again() -> None:
    """The slave was killed before it gave the order to its supervisor."""
    cluster = Cluster("a").with_processes(process("p"))
    cluster.ask(happened.RestartRequested, ("p",), settle=False)
    forget_order(cluster)
    cluster.wait(60.0)
    assert cluster.runs("p") == 1


def test_a_requested_restart_survives_a_restart_of_the_master() -> None:
    """The journal has the run for which the restart was meant."""
    cluster = Cluster("a").with_processes(process("p"))
    cluster.ask(happened.RestartRequested, ("p",), settle=False)
    cluster.restart_master()
    cluster.wait(60.0)
    assert cluster.runs("p") == 1


def test_a_restart_that_was_carried_out_is_not_repeated_by_the_next_master() -> None:
    """The next master sees another run than the one in the journal."""
    cluster = Cluster("a").with_processes(process("p"))
    restart_unreported(cluster)
    cluster.restart_master()
    cluster.wait(60.0)
    assert cluster.runs("p") == 1


def test_a_run_that_its_policy_started_anew_is_not_restarted_by_an_older_order() -> None:
    """The order was meant for the crashed run, not for the one that the policy has started."""
    cluster = Cluster("a").with_processes(process("p", restart=RestartPolicy("always")))
    cluster.ask(happened.RestartRequested, ("p",), settle=False)
    cluster.machines["a"].ordered.clear()
    cluster.finish("p", code=1)
    cluster.wait(60.0)
    assert cluster.runs("p") == 1


def test_a_late_copy_of_a_restart_order_does_not_restart_the_next_run() -> None:
    """The order names the run for which it is meant."""
    cluster = Cluster("a").with_processes(process("p"))
    cluster.restart("p")
    (sent,) = cluster.sent(RestartInstance)
    cluster.machines["a"].ordered.append(sent)
    cluster.wait(10.0)
    assert cluster.runs("p") == 1


def test_a_process_is_not_moved_until_its_restart_is_reported() -> None:
    """Otherwise a restarted silent source would be a second active node."""
    cluster = Cluster("a", "b").with_processes(movable("p"))
    cluster.ask(happened.RestartRequested, ("p",), settle=False)
    cluster.machines["a"].ordered.clear()
    assert "p is being restarted" in cluster.migrate("p", "b").message
    assert "p is being restarted" in cluster.checkpoint("p").message
    cluster.wait(10.0)
    assert cluster.migrate("p", "b").accepted


@pytest.mark.parametrize("state", [InstanceState.EXITED, InstanceState.FAILED])
def test_a_restart_is_not_lost_while_the_instance_stops_for_another_reason(
    state: InstanceState,
) -> None:
    """The process runs again, although the order to restart it was lost and nothing failed."""
    cluster = Cluster("a").with_processes(process("p"))
    machine = cluster.machines["a"]
    (instance,) = machine.programs
    pid = machine.programs[instance].pid
    cluster.ask(happened.RestartRequested, ("p",), settle=False)
    machine.ordered.clear()
    cluster.report("a", InstanceStatus(instance, InstanceState.STOPPING, pid=pid))
    cluster.now += 1.0
    machine._end(instance, state, cluster.now)
    cluster.settle()
    cluster.wait(1.0)
    assert cluster.phase("p") == "running"


def test_a_fenced_instance_is_not_queued_again_because_of_its_pending_restart() -> None:
    """`host_loss: then: stop` decides on a fenced end."""
    cluster = Cluster("a").with_processes(process("p", host_loss=HostLossPolicy("stop")))
    machine = cluster.machines["a"]
    cluster.ask(happened.RestartRequested, ("p",), settle=False)
    machine.ordered.clear()
    machine._end(machine.find("p"), InstanceState.FENCED, cluster.now, signal=9)
    cluster.settle()
    cluster.wait(1.0)
    assert cluster.phase("p") == "failed"


def test_a_restart_of_a_run_that_ended_without_a_master_is_not_lost() -> None:
    """The run is older than the order, whose time is journaled."""
    cluster = Cluster("a").with_processes(process("p"))
    machine = cluster.machines["a"]
    cluster.ask(happened.RestartRequested, ("p",), settle=False)
    machine.ordered.clear()
    cluster.now += 1.0
    cluster.kill_master()
    machine.finish("p", cluster.now, run_time=10.0)
    cluster.restart_master()
    cluster.wait(1.0)
    assert cluster.phase("p") == "running"


@pytest.mark.parametrize("run_time", [1.0, 3600.0])
def test_a_job_whose_restart_was_not_reported_finishes_once(run_time: float) -> None:
    """The statuses of the restart are lost: only a run longer than the time since is older."""
    cluster = Cluster("a").with_processes(job("p"))
    instance = cluster.state.instances[cluster["p"].owner].id
    cluster.ask(happened.RestartRequested, ("p",), settle=False)
    cluster.cut("a", seconds=5.0)
    end = InstanceStatus(instance, InstanceState.EXITED, run_time=run_time)
    machine = cluster.machines["a"]
    machine.batches += 3
    machine.connected = True
    cluster.report("a", end)
    assert (cluster.phase("p") == "finished") is (run_time < 5.0)


def test_a_restart_is_given_up_with_a_record_when_the_host_is_lost() -> None:
    """A host that returns much later does not restart the process."""
    cluster = Cluster("a", "b", lease=5.0).with_processes(process("p"))
    (host,) = cluster.where("p")
    cluster.machines[host].connected = False
    cluster.ask(happened.RestartRequested, ("p",), settle=False)
    cluster.machines[host].ordered.clear()
    cluster.wait(10.0)
    assert cluster.recorded("restart_refused") == [f"p was not restarted: {host} is lost"]
    cluster.reconnect(host, seconds=60.0)
    assert cluster.runs("p") == 0


def test_a_refused_restart_is_recorded_and_not_repeated() -> None:
    """The record has the reason of the slave."""
    cluster = Cluster("a").with_processes(process("p"))
    cluster.ask(happened.RestartRequested, ("p",), settle=False)
    (sent,) = cluster.machines["a"].ordered
    cluster.machines["a"].ordered.clear()
    cluster.tell(happened.OrderAnswered(sent.order_id, accepted=False, message="it shuts down"))
    cluster.wait(60.0)
    assert cluster.recorded("restart_refused") == ["p was not restarted: it shuts down"]
    assert cluster.runs("p") == 0


def test_a_restart_is_ordered_again_if_the_order_was_for_a_former_run_of_the_slave() -> None:
    """The slave was not registered when the order arrived, and did nothing."""
    cluster = Cluster("a").with_processes(process("p"))
    cluster.machines["a"].slave.registered = False
    cluster.restart("p")
    assert cluster.runs("p") == 0
    cluster.machines["a"].slave.registered = True
    cluster.wait(10.0)
    assert cluster.runs("p") == 1
    assert not cluster.recorded("restart_refused")


def test_a_dependant_is_restarted_although_its_slave_forgets_the_accepted_order() -> None:
    """The restart stays due until a status shows it."""
    cluster = Cluster("a").with_processes(process("camera"), follower("p", "camera"))
    cluster.ask(happened.RestartRequested, ("camera",), settle=False)
    machine = cluster.machines["a"]
    cluster.tell(machine.obey(machine.ordered.popleft(), cluster.now))
    while machine.status_batches:
        cluster.tell(machine.status_batches.popleft())
    forget_order(cluster)
    cluster.wait(60.0)
    assert cluster.runs("p") == 1


def test_the_report_after_a_gap_of_the_statuses_is_asked_for_until_it_arrives() -> None:
    """The order may be lost, too; the readings no longer show the gap."""
    cluster = Cluster("a").with_processes(process("p"), process("q"))
    machine = cluster.machines["a"]
    machine._end(machine.find("p"), InstanceState.FAILED, cluster.now, code=3)
    machine.status_batches.clear()
    machine._end(machine.find("q"), InstanceState.FAILED, cluster.now, code=3)
    cluster.tell(machine.status_batches.popleft())
    assert cluster.state.reports_awaited
    lose_orders(cluster)
    cluster.wait(5.0)
    assert (cluster.phase("p"), cluster.phase("q")) == ("failed", "failed")
    assert not cluster.state.reports_awaited


def test_the_order_to_report_is_repeated_with_back_off() -> None:
    """A slave that never reports gets fewer and fewer orders."""
    cluster = Cluster("a").with_processes(process("p"))
    machine = cluster.machines["a"]
    machine.tell(events.ReportRequested(), cluster.now)
    machine.status_batches.clear()
    for _ in range(600):
        cluster.now += 0.1
        cluster.read()
        cluster.tell(happened.TimePassed())
        machine.ordered.clear()
    assert 4 <= len(cluster.orders(ReportInstances)) <= 10


def test_the_stop_of_an_instance_of_another_host_is_repeated_until_it_has_ended() -> None:
    """A journal that lost its end gave the number of a running instance to another process."""
    cluster = Cluster("a", "b").with_processes(process("p"))
    (host,) = cluster.where("p")
    other = cluster.machines[{"a": "b", "b": "a"}[host]]
    assignment = cluster.machines[host].programs[cluster.machines[host].find("p")].assignment
    other.connected = False
    other.tell(events.AssignmentsReceived((assignment,)), cluster.now)
    other.connected = True
    while other.status_batches:
        cluster.tell(other.status_batches.popleft())
    other.ordered.clear()
    cluster.wait(10.0)
    assert cluster.where("p") == [host]
