"""Queue order: FIFO within a priority, waiting, set-aside processes, and return to the queue."""

from __future__ import annotations

import pytest

from rosrm.core.master import events as happened
from rosrm.model.orders import StopInstance
from rosrm.model.records import Record
from rosrm.model.values import InstanceId, InstanceState, InstanceStatus
from tests.unit.core.cluster import MIB, Cluster, Machine, job, process


def full() -> Machine:
    return Machine("a", memory=1000 * MIB, busy={"memory": 0.79, "cpu": 0.0})


def make_room(cluster: Cluster, memory: float = 0.1) -> None:
    cluster.machines["a"].busy["memory"] = memory
    cluster.read()
    cluster.settle()


def test_a_higher_priority_precedes_and_fifo_holds_within_one() -> None:
    """Priority decides, then the order of submission, over several submissions and within one."""
    cluster = Cluster(full())
    for name, priority in (("low1", 0), ("high1", 5), ("low2", 0), ("high2", 5), ("least", -1)):
        cluster.submit(process(name, memory=20, priority=priority))
    cluster.submit(process("low3", memory=20), process("low4", memory=20))
    make_room(cluster)
    assert cluster.assigned() == ["high1", "high2", "low1", "low2", "low3", "low4", "least"]


def test_the_head_of_the_queue_blocks_the_others() -> None:
    """No smaller process passes a process that waits for room."""
    cluster = Cluster(Machine("a", memory=1000 * MIB)).with_processes(process("filler", memory=400))
    cluster.submit(process("large", memory=600), process("small", memory=10))
    assert cluster.queue() == ["large", "small"]
    assert cluster.recorded("waits") == ["large waits: no host can take it now"]


def test_with_backfill_smaller_processes_pass() -> None:
    """The large process keeps its place; equal ones still go in order."""
    cluster = Cluster(Machine("a", memory=1000 * MIB), backfill=True)
    cluster.submit(process("filler", memory=400))
    cluster.submit(
        process("large1", memory=600), process("small1", memory=100), process("large2", memory=600),
        process("small2", memory=100),
    )  # fmt: skip
    assert cluster.assigned() == ["filler", "small1", "small2"]
    assert cluster.queue() == ["large1", "large2"]


def test_a_wait_is_recorded_once_for_each_demand() -> None:
    """Two demands that wait under backfill do not alternate in the record."""
    cluster = Cluster(full(), backfill=True)
    cluster.submit(process("p", memory=100), process("q", memory=50))
    cluster.wait(3.0)
    assert len(cluster.recorded("waits")) == 2


def test_a_process_that_no_host_may_take_is_set_aside() -> None:
    """The reason lists hosts with the same reason together."""
    cluster = Cluster("a", Machine("b", labels={"gpu": "old"}))
    cluster.submit(process("p", required_labels={"gpu": "new"}), process("q"))
    assert cluster.phase("p") == "set_aside"
    assert cluster["p"].reason == "no host may take it: each of a and b lacks the label gpu=new"
    assert cluster.where("q")


def test_a_process_too_large_for_every_host_is_set_aside() -> None:
    """Not even an idle host could take it."""
    cluster = Cluster(Machine("a", memory=1000 * MIB)).with_processes(process("p", memory=900))
    assert cluster.phase("p") == "set_aside"
    assert cluster["p"].reason == (
        "no host may take it: a has 1.0 GB of memory, of which 839 MB (80%) may be used; "
        "needed: 944 MB; there is no other host"
    )
    assert cluster.restart("p").message.startswith("p is set aside: no host may take it: a has ")


@pytest.mark.parametrize("way", ["drain", "cordon", "leave", "cut"])
def test_the_reason_that_holds_for_good_comes_before_an_absence(way: str) -> None:
    """The return of the hosts would not help the process."""
    cluster = Cluster("a", "b").with_processes(process("p", memory=1 << 20))
    large = "no host may take it: each of a and b has 17.2 GB of memory, of which 13.7 GB (80%) "
    large += "may be used; needed: 1.1 TB"
    assert cluster["p"].reason == large
    for host in "ab":
        if way == "leave":
            cluster.leave(host)
        elif way == "cut":
            cluster.cut(host, seconds=60.0)
        else:
            cluster.set_host(host, way)
    cluster.wait(1.0)
    assert cluster["p"].reason == large


def test_a_host_without_a_reading_is_away_not_without_memory() -> None:
    """After a restart of the master, the resources of a host that does not report are unknown."""
    cluster = Cluster("a", "b")
    cluster.cut("b")
    cluster.restart_master()
    cluster.wait(60.0)
    cluster.submit(process("p", memory=1 << 20))
    assert cluster["p"].reason.endswith("needed: 1.1 TB; b is lost")


def test_nothing_is_set_aside_before_the_limits_are_known(monkeypatch) -> None:
    """A host that has registered without a reading may still prove large enough."""
    cluster = Cluster().with_processes(process("p", memory=1200))
    with monkeypatch.context() as patched:
        patched.setattr(cluster, "read", lambda machine: None)
        patched.setattr(cluster, "ask_for_work", lambda machine: None)
        cluster.add(Machine("a", memory=1000 * MIB))
        assert cluster.phase("p") == "queued"
    cluster.wait(0.1)
    assert cluster.phase("p") == "set_aside"
    assert "of which 839 MB (80%) may be used" in cluster["p"].reason


def test_a_misspelt_resource_is_named_with_the_nearest_that_is_reported() -> None:
    """The process is set aside, because a host that reports the resource may still register."""
    cluster = Cluster("a", "b")
    reply = cluster.submit(process("p", needs={"memroy": 1e6}))
    fault = "no host reports the resource 'memroy'; did you mean 'memory'? "
    fault += "(reported: cpu, memory)"
    assert cluster["p"].reason == f"no host may take it: {fault}"
    assert reply.message == f"1 process queued. Warning: {fault}"


def test_restart_of_a_process_that_waits_for_room_is_refused() -> None:
    """The process starts anyway as soon as there is room."""
    cluster = Cluster(full()).with_processes(process("p"))
    assert cluster.restart("p").message == "p waits in the queue already. Nothing was restarted"


def test_a_wait_for_absent_hosts_has_that_reason() -> None:
    """The reason names absent hosts, not full ones."""
    cluster = Cluster("a", "b")
    cluster.leave("a")
    cluster.cut("b", seconds=11.0)
    cluster.submit(process("p"))
    assert cluster["p"].reason == "every host is away: a has left; b is lost"
    assert cluster.recorded("waits") == [f"p waits: {cluster['p'].reason}"]


def test_a_fitting_host_returns_a_process_to_its_place_in_the_queue() -> None:
    """The process goes ahead of those submitted later that still wait."""
    cluster = Cluster(full())
    cluster.submit(process("special", memory=20, required_labels={"gpu": "yes"}))
    cluster.submit(process("plain", memory=20))
    assert cluster.queue() == ["plain"]
    cluster.machines["b"] = machine = Machine("b", labels={"gpu": "yes"})
    machine.takes = False
    cluster.add(machine)
    assert cluster.queue() == ["special", "plain"]
    machine.takes = True
    cluster.wait(0.2)
    assert cluster.where("special") == ["b"]
    assert cluster.where("plain") == ["b"]


def test_without_any_host_all_processes_wait() -> None:
    """No process is set aside before the first host registers."""
    cluster = Cluster().with_processes(process("p", memory=1e6), process("q"))
    assert cluster.queue() == ["p", "q"]
    assert cluster.recorded("waits") == ["p waits: no host has registered yet"]
    cluster.add("a")
    assert cluster.phase("p") == "set_aside"
    assert cluster.where("q") == ["a"]


def test_a_process_that_fits_on_a_cordoned_host_only_does_not_block_the_others() -> None:
    """A cordoned, departed or lost host does not return without an operator."""
    cluster = Cluster("a", Machine("b", labels={"gpu": "yes"}))
    cluster.set_host("b", "cordon")
    cluster.submit(process("special", required_labels={"gpu": "yes"}), process("plain"))
    assert cluster.where("plain") == ["a"]
    assert cluster.phase("special") == "set_aside"
    assert "b is cordoned" in cluster["special"].reason
    cluster.set_host("b", "uncordon")
    assert cluster.where("special") == ["b"]


def test_a_process_that_fits_on_a_lost_host_only_waits_for_its_rejoin() -> None:
    """The lease decides when the process is set aside, the host's next message when it returns."""
    cluster = Cluster("a", Machine("b", labels={"gpu": "yes"}))
    cluster.cut("b", seconds=2.0)
    cluster.submit(process("special", required_labels={"gpu": "yes"}), process("plain"))
    assert cluster.queue() == ["special", "plain"]
    cluster.wait(10.0)
    assert cluster.phase("special") == "set_aside"
    assert cluster.where("plain") == ["a"]
    cluster.reconnect("b", seconds=1.0)
    assert cluster.where("special") == ["b"]


def test_with_all_hosts_away_all_processes_wait_in_order() -> None:
    """If all hosts are away, no process is set aside, since none would be passed."""
    cluster = Cluster("a")
    cluster.set_host("a", "cordon")
    cluster.submit(process("p"), process("q"))
    assert cluster.queue() == ["p", "q"]
    cluster.set_host("a", "uncordon")
    assert cluster.assigned() == ["p", "q"]


def test_a_withdrawn_assignment_returns_to_its_place() -> None:
    """A withdrawn assignment returns to its place ahead of later processes."""
    cluster = Cluster(Machine("a", max_processes=1), delivery_timeout=5.0)
    cluster.decide(happened.SubmissionReceived(1, (job("p"), job("q"))))
    assert cluster.phase("p") == "assigned"
    commands = cluster.decide(happened.AssignmentWithdrawn(InstanceId("p", 1)))
    assert [c.kind for c in commands if isinstance(c, Record)] == ["queued"]
    assert cluster.queue() == ["p", "q"]
    cluster.ask_for_work(cluster.machines["a"])
    assert (cluster.phase("p"), cluster.queue()) == ("assigned", ["q"])


def test_a_lost_assignment_is_sent_again_as_an_order() -> None:
    """The order comes before the assignment counts as not taken up."""
    cluster = Cluster("a", order_retry=2.0, delivery_timeout=5.0)
    cluster.decide(happened.SubmissionReceived(1, (job("p"),)))  # the answer never arrives
    cluster.wait(1.5)
    assert cluster.phase("p") == "assigned"
    cluster.wait(1.0)
    assert (cluster.phase("p"), cluster["p"].owner) == ("running", 1)


def test_a_repeated_assignment_starts_one_instance() -> None:
    """A late answer and the repeated order start one instance."""
    machine = Machine("a")
    cluster = Cluster(machine, order_retry=2.0, delivery_timeout=5.0)
    commands = cluster.decide(happened.SubmissionReceived(1, (job("p"),)))
    cluster.wait(2.5)
    cluster.carry_out(commands)
    cluster.settle()
    assert list(machine.programs) == [InstanceId("p", 1)]


def test_a_repeated_assignment_that_was_withdrawn_never_starts() -> None:
    """Neither the late answer nor the order starts the process."""
    machine = Machine("a")
    cluster = Cluster(machine, order_retry=2.0, delivery_timeout=5.0)
    given = cluster.decide(happened.SubmissionReceived(1, (job("p"),)))
    machine.connected = False
    cluster.now += 2.5
    again = cluster.decide(happened.TimePassed())
    cluster.now += 3.0
    cluster.tell(happened.TimePassed())
    machine.connected = True
    cluster.carry_out([*given, *again])
    cluster.wait(1.0)
    assert list(machine.programs) == [InstanceId("p", 2)]


def test_a_job_that_was_stopped_before_it_ran_has_not_completed() -> None:
    """The late assignment met the stop order: the job ended with code 0 without running."""
    machine = Machine("a")
    cluster = Cluster(machine, order_retry=50.0, delivery_timeout=5.0)
    cluster.decide(happened.SubmissionReceived(1, (job("p"),)))  # the answer is late
    cluster.cut("a", seconds=5.5)
    assert isinstance(machine.ordered.pop().order, StopInstance)
    machine.connected = True
    cluster.report("a", InstanceStatus(InstanceId("p", 1), InstanceState.EXITED, message="stopped"))
    cluster.wait(1.0)
    assert (cluster.phase("p"), cluster["p"].owner) == ("running", 2)
