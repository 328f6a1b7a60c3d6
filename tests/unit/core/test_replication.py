"""Snapshot replication in the core: policy calls, orders to slaves, replicas at a start."""

from __future__ import annotations

from typing import Any

import pytest

from rosrm.core.master import events as happened
from rosrm.core.master.commands import Assign
from rosrm.extensions.contracts import CheckpointChoice, CheckpointView
from rosrm.model.orders import DropReplica, ReplicateSnapshot
from rosrm.model.values import (
    HostLossPolicy,
    InstanceId,
    MigrationPolicy,
    ProcessSpec,
    Readiness,
    SnapshotReport,
)
from tests.unit.core.cluster import Cluster, job, process


class Asked:
    """Checkpoint policy that returns a set answer and records its questions."""

    def __init__(self, *hosts: str, every: float = 1.0) -> None:
        self.answer: Any = CheckpointChoice(hosts, every)
        self.views: list[CheckpointView] = []

    def choose(self, view: CheckpointView) -> CheckpointChoice | None:
        self.views.append(view)
        if isinstance(self.answer, Exception):
            raise self.answer
        return self.answer


def stateful(name: str = "p", **fields: Any) -> ProcessSpec:
    fields.setdefault("host_loss", HostLossPolicy("elsewhere"))
    fields.setdefault("readiness", Readiness("running"))
    return process(name, ros=True, migration=MigrationPolicy("handoff"), **fields)


def keep(cluster: Cluster, host: str, *states: tuple[str, int, int]) -> None:
    """Report all snapshots of a host: process, instance, sequence."""
    machine = cluster.machines[host]
    kept = tuple(
        SnapshotReport(InstanceId(name, number), sequence, 100) for name, number, sequence in states
    )
    cluster.tell(happened.KeptStatesReceived(machine.host_id, machine.incarnation, kept))


def running(policy: Asked | None, *hosts: str, spec: ProcessSpec | None = None) -> Cluster:
    """Return a cluster with a running stateful process whose snapshot is on its own host."""
    cluster = Cluster(*(hosts or ("a", "b", "c")), lease=3.0)
    cluster.state.replication.policy, cluster.state.replication.policy_name = policy, "asked"
    cluster.submit(spec or stateful())
    cluster.wait(1.0)
    assert cluster.phase("p") == "running"
    keep(cluster, where(cluster), ("p", cluster["p"].owner, 5))
    return cluster


def where(cluster: Cluster, name: str = "p") -> str:
    (host,) = cluster.where(name)
    return host


def others(cluster: Cluster) -> list[str]:
    return [name for name in cluster.machines if name != where(cluster)]


def assigned(cluster: Cluster) -> Any:
    """Return the newest assignment."""
    return [one for one in cluster.carried if isinstance(one, Assign)][-1].assignment


def test_the_policys_choice_is_told_once():
    """The slave receives the hosts of the replicas once, and again after a change."""
    policy = Asked("b")
    cluster = running(policy, "a", "b")
    host = where(cluster)
    policy.answer = CheckpointChoice((others(cluster)[0],), 2.0)
    cluster.wait(10.0)
    orders = cluster.orders(ReplicateSnapshot)
    assert [(one.hosts, one.every) for one in orders[-1:]] == [((others(cluster)[0],), 2.0)]
    assert {one.host_id for one in cluster.sent(ReplicateSnapshot)} == {
        cluster.machines[host].host_id
    }
    assert orders[-1].instance == InstanceId("p", cluster["p"].owner)
    told = len(orders)
    policy.answer = None  # as before
    cluster.wait(10.0)
    assert len(cluster.orders(ReplicateSnapshot)) == told


def test_the_order_of_the_hosts_that_are_chosen_makes_no_difference():
    """A policy that lists the hosts as `kept_on` does causes no order and no event."""
    policy = Asked()
    cluster = running(policy)
    one, two = others(cluster)
    policy.answer = CheckpointChoice((one, two))
    cluster.wait(3.0)
    told, recorded = len(cluster.orders(ReplicateSnapshot)), cluster.recorded("kept_on")
    policy.answer = CheckpointChoice((two, one))
    cluster.wait(10.0)
    assert (len(cluster.orders(ReplicateSnapshot)), cluster.recorded("kept_on")) == (told, recorded)


def test_what_the_policy_sees():
    """The view has the hosts that are up, their labels, the replicas and the age of the newest."""
    policy = Asked()
    cluster = running(policy)
    other = others(cluster)[0]
    cluster.wait(1.0)
    assert (policy.views[-1].age, policy.views[-1].kept_on) == (None, ())
    keep(cluster, other, ("p", cluster["p"].owner, 4))
    cluster.wait(5.0)
    view = policy.views[-1]
    assert view.host == where(cluster)
    assert view.kept_on == (other,)
    assert view.age == pytest.approx(5.0, abs=1.2)
    assert set(view.hosts) == {"a", "b", "c"}
    assert view.size == 100


def test_it_is_asked_about_once_a_second_for_each_process():
    """The rate does not depend on the number of processes or of ticks."""
    policy = Asked()
    cluster = Cluster("a", "b")
    cluster.state.replication.policy = policy
    names = [f"p{n}" for n in range(30)]
    cluster.submit(*(stateful(name) for name in names))
    cluster.wait(1.0)
    for host in ("a", "b"):
        mine = [name for name in names if cluster.where(name) == [host]]
        keep(cluster, host, *((name, cluster[name].owner, 1) for name in mine))
    policy.views.clear()
    cluster.wait(10.0)
    assert 8 * 30 <= len(policy.views) <= 12 * 30
    assert {view.spec.name for view in policy.views} == set(names)


@pytest.mark.parametrize(
    "answer",
    [
        ValueError("no idea"),
        CheckpointChoice(("nowhere",)),
        CheckpointChoice(("b", "b")),
        CheckpointChoice(("b",), every=0.0),
        "b",
    ],
)
def test_a_policy_that_raises_or_makes_no_sense_is_named(answer):
    """The replication that was ordered before stays in place."""
    policy = Asked()
    cluster = running(policy, "a", "b")
    policy.answer = answer
    if isinstance(answer, CheckpointChoice) and where(cluster) == "b":
        cluster.migrate("p", "a")
        cluster.wait(10.0)
        keep(cluster, where(cluster), ("p", cluster["p"].owner, 5))
    told = len(cluster.orders(ReplicateSnapshot))
    cluster.wait(25.0)
    (first, *_) = cluster.recorded("plugin_failed")
    assert first.startswith("the checkpoint policy 'asked' fails: choose: ")
    assert len(cluster.recorded("plugin_failed")) == 1
    assert all(order.hosts == () for order in cluster.orders(ReplicateSnapshot)[told:])


@pytest.mark.parametrize("answer", [None, ValueError("no idea"), TimeoutError("late")])
def test_copies_stay_after_a_start_of_the_master_until_the_policy_answers(answer):
    """The snapshot is sent to the hosts that report a replica, and no replica is deleted."""
    policy = Asked("b", "c")
    cluster = running(policy, "a", "b", "c")
    number, host = cluster["p"].owner, where(cluster)
    one, two = others(cluster)
    policy.answer = answer
    cluster.kill_master()
    cluster.state.replication.policy, cluster.state.replication.policy_name = policy, "asked"
    register(cluster, host, ("p", number, 9))
    register(cluster, one, ("p", number, 8))
    cluster.wait(3.0)
    register(cluster, two, ("p", number, 7))  # registers later, with an older snapshot
    cluster.wait(5.0)
    assert not cluster.orders(DropReplica)
    assert cluster.orders(ReplicateSnapshot)[-1].hosts == (one, two)
    policy.answer = CheckpointChoice((one,))
    cluster.wait(3.0)
    (dropped, *_) = cluster.sent(DropReplica)
    assert dropped.host_id == cluster.machines[two].host_id


def test_a_choice_of_the_processs_own_host_is_refused():
    policy = Asked()
    cluster = running(policy, "a", "b")
    policy.answer = CheckpointChoice((where(cluster),))
    cluster.wait(2.0)
    assert cluster.recorded("plugin_failed")


def test_a_slave_that_was_started_anew_is_told_again():
    """A new run of a slave does not know the orders of the former run."""
    policy = Asked()
    cluster = running(policy, "a", "b")
    policy.answer = CheckpointChoice((others(cluster)[0],))
    cluster.wait(2.0)
    told, machine = len(cluster.orders(ReplicateSnapshot)), cluster.machines[where(cluster)]
    machine.incarnation += 100
    machine.connected = False
    cluster.wait(1.5)
    machine.connected = True
    cluster.register(machine)
    keep(cluster, machine.name, ("p", cluster["p"].owner, 6))
    cluster.wait(2.0)
    assert len(cluster.orders(ReplicateSnapshot)) == told + 1


def test_after_the_loss_of_its_host_the_start_is_told_where_the_state_lies():
    """The hosts are listed newest first, without lost ones; a host with a snapshot is preferred."""
    cluster = running(Asked())
    host, (one, two) = where(cluster), others(cluster)
    number = cluster["p"].owner
    # Without the snapshot the host with less load would be chosen.
    cluster.machines[two].busy = {"memory": 0.3, "cpu": 0.3}
    keep(cluster, two, ("p", number, 4))
    cluster.machines[host].connected = False
    cluster.wait(6.0)
    assert cluster.where("p")[-1:] == [two] or two in cluster.where("p")
    assignment = assigned(cluster)
    assert assignment.kept_on == (two,)
    assert assignment.kept_from <= number < assignment.instance.number
    assert one not in assignment.kept_on


def test_a_restarted_one_is_kept_elsewhere_from_its_first_state_on():
    """The slave receives the order before its first report, because a second loss may come soon."""
    policy = Asked()
    cluster = running(policy)
    lost, (keeper, _) = where(cluster), others(cluster)
    keep(cluster, keeper, ("p", cluster["p"].owner, 4))
    cluster.machines[lost].connected = False
    cluster.wait(6.0)
    now_on = next(host for host in cluster.where("p") if host != lost)
    policy.answer = CheckpointChoice(
        tuple(name for name in cluster.machines if name not in (lost, now_on))
    )
    cluster.wait(1.2)
    newest = cluster.sent(ReplicateSnapshot)[-1]
    assert newest.order.instance == InstanceId("p", cluster["p"].owner)
    assert newest.host_id == cluster.machines[now_on].host_id


def test_a_failed_process_that_is_restarted_goes_on_from_its_state():
    """The restart does not ask for a start from nothing, so the snapshot is used."""
    cluster = running(Asked())
    host, number = where(cluster), cluster["p"].owner
    cluster.machines[host].finish("p", cluster.now, code=1)
    cluster.settle()
    assert cluster.phase("p") == "failed"
    cluster.wait(3.0)
    assert not cluster.orders(DropReplica)
    cluster.restart("p")
    assignment = assigned(cluster)
    assert assignment.kept_on == (host,)
    assert assignment.kept_from <= number
    assert cluster.where("p") == [host]


def test_what_is_cancelled_is_dropped_everywhere_and_begins_from_nothing():
    """The drop includes hosts that were away at the cancel."""
    policy = Asked()
    cluster = running(policy)
    host, other = where(cluster), others(cluster)[0]
    number = cluster["p"].owner
    policy.answer = CheckpointChoice((other,))
    cluster.wait(2.0)
    keep(cluster, other, ("p", number, 4))
    cluster.machines[other].connected = False
    cluster.wait(2.0)
    cluster.cancel("p")
    cluster.wait(3.0)
    dropped = {sent.host_id for sent in cluster.sent(DropReplica)}
    assert dropped == {cluster.machines[host].host_id}
    keep(cluster, host)
    cluster.submit(stateful())
    assert assigned(cluster).kept_on == ()
    assert assigned(cluster).kept_from > number
    cluster.machines[other].connected = True
    cluster.wait(3.0)
    assert cluster.sent(DropReplica)[-1].host_id == cluster.machines[other].host_id
    assert cluster.orders(DropReplica)[-1].instance == InstanceId("p", number)


def test_the_replicas_of_a_pruned_process_are_dropped():
    """Hosts that return after the prune drop them, too; those of an unknown later instance stay."""
    cluster = running(Asked())
    host, (other, third) = where(cluster), others(cluster)
    number = cluster["p"].owner
    keep(cluster, other, ("p", number, 4))
    cluster.machines[other].connected = False
    cluster.machines[host].finish("p", cluster.now, code=1)
    cluster.wait(2.0)
    assert cluster.phase("p") == "failed"
    assert not cluster.orders(DropReplica)
    assert cluster.ask(happened.PruneRequested, ("p",), ()).accepted
    keep(cluster, third, ("p", number + 70, 1))
    cluster.wait(2.0)
    assert {sent.host_id for sent in cluster.sent(DropReplica)} == {cluster.machines[host].host_id}
    keep(cluster, host)
    cluster.machines[other].connected = True
    cluster.wait(3.0)
    last = cluster.sent(DropReplica)[-1]
    assert (last.host_id, last.order) == (
        cluster.machines[other].host_id, DropReplica(InstanceId("p", number))
    )  # fmt: skip
    dropped_on = {sent.host_id for sent in cluster.sent(DropReplica)}
    assert cluster.machines[third].host_id not in dropped_on


def test_what_was_pruned_is_not_forgotten_with_the_master():
    """A host that returns after a restart of the master is ordered to drop it, and nothing else."""
    cluster = running(Asked())
    number, (other, *_) = cluster["p"].owner, others(cluster)
    cluster.machines[where(cluster)].finish("p", cluster.now, code=1)
    cluster.wait(2.0)
    assert cluster.ask(happened.PruneRequested, ("p",), ()).accepted
    cluster.restart_master()
    before = len(cluster.orders(DropReplica))
    keep(cluster, other, ("p", number, 4), ("stranger", number, 4))
    cluster.wait(2.0)
    assert {(one.host_id, one.order) for one in cluster.sent(DropReplica)[before:]} == {
        (cluster.machines[other].host_id, DropReplica(InstanceId("p", number)))
    }


def test_where_it_was_submitted_is_not_forgotten_with_the_master():
    """A snapshot from before the submission stays unused after a restart of the master too."""
    cluster = running(Asked())
    other, number = others(cluster)[0], cluster["p"].owner
    cluster.cancel("p")
    cluster.submit(stateful())
    cluster.restart_master()
    keep(cluster, other, ("p", number, 4))
    assert cluster["p"].born > number


def test_after_a_move_the_copies_of_the_source_are_dropped_once_there_is_a_newer_one():
    """The old replicas are the only ones if the new host is lost before its first snapshot."""
    cluster = running(Asked(), "a", "b")
    source = where(cluster)
    number = cluster["p"].owner
    (destination,) = others(cluster)
    cluster.migrate("p", destination)
    cluster.wait(20.0)
    assert cluster.where("p") == [destination]
    assert not cluster.orders(DropReplica)
    keep(cluster, destination, ("p", cluster["p"].owner, 9))
    cluster.wait(3.0)
    (sent, *_) = cluster.sent(DropReplica)
    assert sent.host_id == cluster.machines[source].host_id
    assert sent.order == DropReplica(InstanceId("p", number))


def test_an_explanation_says_where_the_state_is_kept():
    """Replicas are listed newest first, with the sequence number and the age."""
    cluster = running(Asked("b", "c"))
    number = cluster["p"].owner
    (other, *_) = others(cluster)
    keep(cluster, other, ("p", number, 3))
    cluster.wait(0.5)
    kept = cluster.explain("p")["kept"]
    assert [(one["host"], one["number"], one["sequence"]) for one in kept] == [
        (where(cluster), number, 5), (other, number, 3)
    ]  # fmt: skip
    assert kept[1]["elapsed"] == pytest.approx(0.5)


def test_without_a_policy_it_is_kept_on_its_own_host_alone():
    """An assignment to another host still lists where the snapshot is."""
    cluster = running(None)
    cluster.wait(3.0)
    assert all(order.hosts == () for order in cluster.orders(ReplicateSnapshot))
    assert not cluster.orders(DropReplica)


def test_stateless_processes_and_strangers_are_left_alone():
    """Snapshots of an unknown process stay, because the journal may be lost."""
    cluster = Cluster("a")
    cluster.submit(process("s"), job("j"))
    keep(cluster, "a", ("unknown", 70, 3))
    cluster.wait(3.0)
    assert not cluster.orders(ReplicateSnapshot)
    assert not cluster.orders(DropReplica)
    assert assigned(cluster).kept_on == ()
    cluster.submit(process("t"))
    assert assigned(cluster).instance.number > 70, "no number is used twice"


def register(cluster: Cluster, host: str, *states: tuple[str, int, int]) -> None:
    """Register a slave, which reports its snapshots at once."""
    machine = cluster.machines[host]
    kept = tuple(
        SnapshotReport(InstanceId(name, number), sequence, 100) for name, number, sequence in states
    )
    cluster.register(machine, kept)


def test_a_master_that_starts_knows_what_a_host_keeps_as_soon_as_it_registers():
    """A start caused by this registration already uses the reported snapshot."""
    cluster = running(Asked(), "a", "b")
    host, number = where(cluster), cluster["p"].owner
    register(cluster, others(cluster)[0])
    cluster.kill_master()
    machine = cluster.machines[host]
    machine.programs.clear()  # the process ended and was forgotten while there was no master
    machine.slave.held.clear()
    register(cluster, others_of(cluster, host)[0])
    register(cluster, host, ("p", number, 5))
    cluster.wait(1.0)
    assert assigned(cluster).instance.number > number
    assert assigned(cluster).kept_on == (host,)


def others_of(cluster: Cluster, host: str) -> list[str]:
    return [name for name in cluster.machines if name != host]


def test_after_a_start_of_the_master_its_state_may_lie_on_a_host_that_comes_back_later():
    """The process waits for that host for one lease; other queued processes do not wait."""
    cluster = running(Asked())
    host, left = where(cluster), others(cluster)
    for name in left:
        cluster.machines[name].takes = False
    cluster.machines[host].connected = False
    cluster.wait(6.0)
    assert cluster.queue() == ["p"]
    cluster.kill_master()
    for name in left:
        cluster.machines[name].takes = True
        register(cluster, name)
    cluster.submit(process("behind"))
    cluster.wait(1.0)
    assert cluster.phase("behind") == "running"
    assert cluster.queue() == ["p"]
    assert "has not come back yet" in cluster["p"].reason
    cluster.wait(4.0)  # the lease has expired
    assert cluster.phase("p") == "running"


def test_the_last_copy_may_vanish_while_processes_are_looked_at():
    """The last replica may be on a host that was ordered to drop it."""
    policy = Asked()
    cluster = running(policy)
    cluster.wait(3.0)
    cluster.state.replication.waiting = ["p"]
    keep(cluster, where(cluster), ("another", cluster["p"].owner + 1, 5))
    cluster.wait(3.0)
    assert cluster.phase("p") == "running"
    assert policy.views[-1].size == 0


def lost_with_its_copy() -> tuple[Cluster, str, str]:
    """Return a cluster that lost the hosts of a process and of its replica at the same time."""
    cluster = running(Asked())
    host, (keeper, left) = where(cluster), others(cluster)
    keep(cluster, keeper, ("p", cluster["p"].owner, 4))
    for name in (host, keeper):
        cluster.machines[name].connected = False
    cluster.wait(4.5)  # the lease has expired, and the next one has begun
    assert cluster.queue() == ["p"]
    assert "has not come back yet" in cluster["p"].reason
    return cluster, keeper, left


def test_when_the_copy_is_lost_too_its_host_may_come_back():
    """A host that rejoins within the next lease provides the snapshot."""
    cluster, keeper, _ = lost_with_its_copy()
    cluster.machines[keeper].connected = True
    cluster.wait(1.0)
    assert assigned(cluster).kept_on == (keeper,)


def test_when_the_copy_stays_lost_it_begins_from_nothing():
    """One lease later the process starts from nothing, because no host has its snapshot."""
    cluster, _, left = lost_with_its_copy()
    cluster.wait(3.0)
    assert left in cluster.where("p")
    assert assigned(cluster).kept_on == ()


def test_a_host_that_was_to_keep_the_state_is_asked_for_it_though_it_has_not_said_so():
    """The newest replica may have arrived there after the last report."""
    policy = Asked()
    cluster = running(policy)
    host, (keeper, stale) = where(cluster), others(cluster)
    keep(cluster, stale, ("p", cluster["p"].owner, 1))
    policy.answer = CheckpointChoice((keeper,))
    cluster.wait(2.0)
    cluster.machines[host].connected = False
    cluster.wait(4.0)
    assert assigned(cluster).kept_on == (keeper, stale)
