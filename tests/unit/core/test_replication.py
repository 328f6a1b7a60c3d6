"""Snapshot replication in the core: policy calls, orders to slaves, replicas at a start."""

from __future__ import annotations

from decimal import Decimal
from itertools import repeat
from typing import Any

import pytest

from rosrm.core.master import events as happened
from rosrm.core.master.commands import Assign
from rosrm.extensions.contracts import CheckpointChoice, CheckpointView
from rosrm.model.orders import DropReplica, ReplicateSnapshot
from rosrm.model.values import (
    HostLossPolicy,
    InstanceId,
    InstanceState,
    InstanceStatus,
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


def reported(*states: tuple[str, int, int]) -> tuple[SnapshotReport, ...]:
    """Return reports of snapshots: process, instance, sequence."""
    return tuple(
        SnapshotReport(InstanceId(name, number), sequence, 100) for name, number, sequence in states
    )


def keep(cluster: Cluster, host: str, *states: tuple[str, int, int]) -> None:
    """Report all snapshots of a host: process, instance, sequence."""
    machine = cluster.machines[host]
    snapshots = reported(*states)
    cluster.tell(happened.SnapshotsReported(machine.host_id, machine.incarnation, snapshots))


def register(cluster: Cluster, host: str, *states: tuple[str, int, int]) -> None:
    """Register a slave, which reports its snapshots at once."""
    cluster.register(cluster.machines[host], reported(*states))


def use(cluster: Cluster, policy: Any) -> None:
    """Select a checkpoint policy."""
    cluster.state.replication.policy, cluster.state.replication.policy_name = policy, "asked"


def running(policy: Asked | None, *hosts: str, spec: ProcessSpec | None = None) -> Cluster:
    """Return a cluster with a running stateful process whose snapshot is on its own host."""
    cluster = Cluster(*(hosts or ("a", "b", "c")), lease=3.0)
    use(cluster, policy)
    cluster.submit(spec or stateful())
    cluster.wait(1.0)
    assert cluster.phase("p") == "running"
    keep(cluster, where(cluster), ("p", cluster["p"].owner, 5))
    return cluster


def where(cluster: Cluster, name: str = "p") -> str:
    (host,) = cluster.where(name)
    return host


def others(cluster: Cluster, than: str = "") -> list[str]:
    """Return the hosts without the process, or all but one."""
    return [name for name in cluster.machines if name != (than or where(cluster))]


def assigned(cluster: Cluster) -> Any:
    """Return the newest assignment."""
    return [one for one in cluster.carried if isinstance(one, Assign)][-1].assignment


def test_the_slave_gets_the_choice_of_the_policy_once():
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


def test_the_order_of_the_chosen_hosts_makes_no_difference():
    """A policy that lists the hosts as `replica_hosts` does causes no order and no event."""
    policy = Asked()
    cluster = running(policy)
    one, two = others(cluster)
    policy.answer = CheckpointChoice((one, two))
    cluster.wait(3.0)
    told, recorded = len(cluster.orders(ReplicateSnapshot)), cluster.recorded("kept_on")
    policy.answer = CheckpointChoice((two, one))
    cluster.wait(10.0)
    assert (len(cluster.orders(ReplicateSnapshot)), cluster.recorded("kept_on")) == (told, recorded)


def test_the_policy_gets_hosts_replicas_and_age():
    """The view has the hosts that are up, their labels, the replicas and the age of the newest."""
    policy = Asked()
    cluster = running(policy)
    other = others(cluster)[0]
    cluster.wait(1.0)
    assert (policy.views[-1].age, policy.views[-1].replica_hosts) == (None, ())
    keep(cluster, other, ("p", cluster["p"].owner, 4))
    cluster.wait(5.0)
    view = policy.views[-1]
    assert view.host == where(cluster)
    assert view.replica_hosts == (other,)
    assert view.age == pytest.approx(5.0, abs=1.2)
    assert set(view.hosts) == {"a", "b", "c"}
    assert view.size == 100


def test_the_policy_is_called_once_a_second_for_each_process():
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
        lambda own, other: CheckpointChoice(("nowhere",)),
        lambda own, other: CheckpointChoice((other, other)),
        lambda own, other: CheckpointChoice((own,)),
        lambda own, other: CheckpointChoice((other,), every=0.0),
        lambda own, other: ValueError("no idea"),
        lambda own, other: other,
    ],
    ids=["unknown host", "one host twice", "own host", "period", "exception", "type"],
)
def test_a_policy_that_raises_or_gives_an_invalid_choice_is_named(answer):
    """The replication that was ordered before stays in place."""
    policy = Asked()
    cluster = running(policy, "a", "b")
    policy.answer = answer(where(cluster), others(cluster)[0])
    ordered = len(cluster.orders(ReplicateSnapshot))
    cluster.wait(25.0)
    (message,) = cluster.recorded("plugin_failed")
    assert message.startswith("the checkpoint policy 'asked' fails: choose: ")
    assert all(order.hosts == () for order in cluster.orders(ReplicateSnapshot)[ordered:])


def test_a_choice_of_similar_types_is_ordered_in_the_declared_ones():
    """A list, or a number that no message can hold, would fail after the call of the policy."""
    policy = Asked()
    cluster = running(policy, "a", "b")
    policy.answer = CheckpointChoice([others(cluster)[0]], every=Decimal("2.5"))
    cluster.wait(5.0)
    order = cluster.orders(ReplicateSnapshot)[-1]
    assert order.hosts == (others(cluster)[0],)
    assert (type(order.every), order.every) == (float, 2.5)


def test_a_policy_changes_neither_the_spec_nor_the_labels_of_hosts():
    """Otherwise the next start would have another environment, and hosts other labels."""

    class Changing(Asked):
        def choose(self, process):
            process.spec.environment["A"] = "2"
            process.spec.parameters["list"].append(3)
            for labels in process.hosts.values():
                labels["rack"] = "odd"

    spec = stateful(environment={"A": "1"}, parameters={"list": [1]})
    cluster = running(Changing(), "a", "b", spec=spec)
    cluster.wait(5.0)
    (failure,) = cluster.recorded("plugin_failed")
    assert "does not support item assignment" in failure
    known = cluster["p"].spec
    assert (known.environment, known.parameters) == ({"A": "1"}, {"list": [1]})


def test_a_choice_of_endless_hosts_costs_one_call():
    """An alarm could not end the loop in C that would convert endless hosts to a tuple."""
    policy = Asked()
    cluster = running(policy, "a", "b")
    policy.answer = CheckpointChoice(repeat(others(cluster)[0]))  # type: ignore[arg-type]
    cluster.wait(5.0)
    assert cluster.recorded("plugin_failed")


@pytest.mark.parametrize("answer", [None, ValueError("no idea"), TimeoutError("late")])
def test_replicas_stay_after_a_start_of_the_master_until_the_policy_answers(answer):
    """The snapshot is sent to the hosts that report a replica, and no replica is deleted."""
    policy = Asked("b", "c")
    cluster = running(policy, "a", "b", "c")
    number, host = cluster["p"].owner, where(cluster)
    one, two = others(cluster)
    policy.answer = answer
    cluster.kill_master()
    use(cluster, policy)
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


def test_the_next_run_of_a_slave_gets_the_order_again():
    """A new run of a slave does not know the orders of the former run."""
    policy = Asked()
    cluster = running(policy, "a", "b")
    policy.answer = CheckpointChoice((others(cluster)[0],))
    cluster.wait(2.0)
    orders, host = len(cluster.orders(ReplicateSnapshot)), where(cluster)
    cluster.machines[host].incarnation += 100
    cluster.cut(host, seconds=1.5)
    cluster.rejoin(host, 0.0)
    keep(cluster, host, ("p", cluster["p"].owner, 6))
    cluster.wait(2.0)
    assert len(cluster.orders(ReplicateSnapshot)) == orders + 1


def test_a_start_after_a_loss_names_the_hosts_of_the_snapshot():
    """The hosts are listed newest first, without lost ones; a host with a snapshot is preferred."""
    cluster = running(Asked())
    host, (one, two) = where(cluster), others(cluster)
    number = cluster["p"].owner
    # Without the snapshot the host with less load would be chosen.
    cluster.machines[two].busy = {"memory": 0.3, "cpu": 0.3}
    keep(cluster, two, ("p", number, 4))
    cluster.cut(host, seconds=6.0)
    assert cluster.where("p")[-1:] == [two] or two in cluster.where("p")
    assignment = assigned(cluster)
    assert assignment.snapshot_hosts == (two,)
    assert assignment.snapshots_from <= number < assignment.instance.number
    assert one not in assignment.snapshot_hosts


def test_a_restarted_process_is_replicated_from_its_first_snapshot_on():
    """The slave receives the order before its first report, because a second loss may come soon."""
    policy = Asked()
    cluster = running(policy)
    lost, (keeper, _) = where(cluster), others(cluster)
    keep(cluster, keeper, ("p", cluster["p"].owner, 4))
    cluster.cut(lost, seconds=6.0)
    now_on = next(host for host in cluster.where("p") if host != lost)
    policy.answer = CheckpointChoice(
        tuple(name for name in cluster.machines if name not in (lost, now_on))
    )
    cluster.wait(1.2)
    newest = cluster.sent(ReplicateSnapshot)[-1]
    assert newest.order.instance == InstanceId("p", cluster["p"].owner)
    assert newest.host_id == cluster.machines[now_on].host_id


def test_a_failed_process_that_is_restarted_continues_from_its_snapshot():
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
    assert assignment.snapshot_hosts == (host,)
    assert assignment.snapshots_from <= number
    assert cluster.where("p") == [host]


def test_the_replicas_of_a_cancelled_process_are_dropped_everywhere():
    """The drop includes hosts that were away at the cancel."""
    policy = Asked()
    cluster = running(policy)
    host, other = where(cluster), others(cluster)[0]
    number = cluster["p"].owner
    policy.answer = CheckpointChoice((other,))
    cluster.wait(2.0)
    keep(cluster, other, ("p", number, 4))
    cluster.cut(other, seconds=2.0)
    cluster.cancel("p")
    cluster.wait(3.0)
    dropped = {sent.host_id for sent in cluster.sent(DropReplica)}
    assert dropped == {cluster.machines[host].host_id}
    keep(cluster, host)
    cluster.submit(stateful())
    assert assigned(cluster).snapshot_hosts == ()
    assert assigned(cluster).snapshots_from > number
    cluster.reconnect(other, seconds=3.0)
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
    cluster.reconnect(other, seconds=3.0)
    last = cluster.sent(DropReplica)[-1]
    assert (last.host_id, last.order) == (
        cluster.machines[other].host_id, DropReplica(InstanceId("p", number))
    )  # fmt: skip
    dropped_on = {sent.host_id for sent in cluster.sent(DropReplica)}
    assert cluster.machines[third].host_id not in dropped_on


def test_the_order_about_a_pruned_process_is_forgotten():
    """Otherwise a master would keep one for each name that ever had a snapshot."""
    policy = Asked()
    cluster = running(policy)
    policy.answer = CheckpointChoice((others(cluster)[0],))
    cluster.wait(2.0)
    assert "p" in cluster.state.replication.last_orders
    for name in cluster.machines:
        keep(cluster, name)
    cluster.cancel("p")
    cluster.wait(2.0)
    assert cluster.ask(happened.PruneRequested, ("p",), ()).accepted
    cluster.wait(2.0)
    assert cluster.state.replication.last_orders == {}


def test_the_next_master_drops_the_replicas_of_a_pruned_process():
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


def test_the_next_master_uses_no_snapshot_from_before_the_submission():
    """A snapshot from before the submission stays unused after a restart of the master too."""
    cluster = running(Asked())
    other, number = others(cluster)[0], cluster["p"].owner
    cluster.cancel("p")
    cluster.submit(stateful())
    cluster.restart_master()
    keep(cluster, other, ("p", number, 4))
    assert cluster["p"].born > number


def test_after_a_move_the_replicas_of_the_source_are_dropped_with_a_newer_one():
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


def test_an_explanation_lists_the_replicas():
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


def test_without_a_policy_a_snapshot_is_on_its_own_host_alone():
    """An assignment to another host still lists where the snapshot is."""
    cluster = running(None)
    cluster.wait(3.0)
    assert all(order.hosts == () for order in cluster.orders(ReplicateSnapshot))
    assert not cluster.orders(DropReplica)


def test_stateless_and_unknown_processes_cause_no_order():
    """Snapshots of an unknown process stay, because the journal may be lost."""
    cluster = Cluster("a").with_processes(process("s"), job("j"))
    keep(cluster, "a", ("unknown", 70, 3))
    cluster.wait(3.0)
    assert not cluster.orders(ReplicateSnapshot)
    assert not cluster.orders(DropReplica)
    assert assigned(cluster).snapshot_hosts == ()
    cluster.submit(process("t"))
    assert assigned(cluster).instance.number > 70, "no number is used twice"


def test_a_registration_brings_the_replicas_of_the_host():
    """A start caused by this registration already uses the reported snapshot."""
    cluster = running(Asked(), "a", "b")
    host, number = where(cluster), cluster["p"].owner
    register(cluster, others(cluster)[0])
    cluster.kill_master()
    machine = cluster.machines[host]
    machine.programs.clear()  # the process ended and was forgotten while there was no master
    machine.slave.held.clear()
    register(cluster, others(cluster, host)[0])
    register(cluster, host, ("p", number, 5))
    cluster.wait(1.0)
    assert assigned(cluster).instance.number > number
    assert assigned(cluster).snapshot_hosts == (host,)


def test_after_a_start_of_the_master_a_process_waits_for_the_host_of_its_snapshot():
    """The process waits for that host for one lease; other queued processes do not wait."""
    cluster = running(Asked())
    host, left = where(cluster), others(cluster)
    for name in left:
        cluster.machines[name].takes = False
    cluster.cut(host, seconds=6.0)
    assert cluster.queue() == ["p"]
    cluster.kill_master()
    for name in left:
        cluster.machines[name].takes = True
        register(cluster, name)
    cluster.submit(process("behind"))
    cluster.wait(1.0)
    assert cluster.phase("behind") == "running"
    assert cluster.queue() == ["p"]
    assert "has not rejoined yet" in cluster["p"].reason
    cluster.wait(4.0)  # the lease has expired
    assert cluster.phase("p") == "running"


def test_the_last_replica_may_vanish_during_the_review():
    """The last replica may be on a host that was ordered to drop it."""
    policy = Asked()
    cluster = running(policy)
    cluster.wait(3.0)
    cluster.state.replication.waiting = ["p"]
    keep(cluster, where(cluster), ("another", cluster["p"].owner + 1, 5))
    cluster.wait(3.0)
    assert cluster.phase("p") == "running"
    assert policy.views[-1].size == 0


@pytest.mark.parametrize("rejoins", [True, False])
def test_a_process_whose_replica_is_lost_too_waits_one_lease_for_it(rejoins: bool):
    """A host that rejoins within the next lease provides the snapshot.

    Otherwise the process starts from nothing, because no host has its snapshot.
    """
    cluster = running(Asked())
    host, (keeper, left) = where(cluster), others(cluster)
    keep(cluster, keeper, ("p", cluster["p"].owner, 4))
    cluster.cut(host, keeper, seconds=4.5)  # the lease has expired, and the next one has begun
    assert cluster.queue() == ["p"]
    assert "has not rejoined yet" in cluster["p"].reason
    if rejoins:
        cluster.reconnect(keeper, seconds=1.0)
        assert assigned(cluster).snapshot_hosts == (keeper,)
    else:
        cluster.wait(3.0)
        assert left in cluster.where("p")
        assert assigned(cluster).snapshot_hosts == ()


def test_a_start_also_names_a_host_whose_replica_is_not_reported_yet():
    """The newest replica may have arrived there after the last report."""
    policy = Asked()
    cluster = running(policy)
    host, (keeper, stale) = where(cluster), others(cluster)
    keep(cluster, stale, ("p", cluster["p"].owner, 1))
    policy.answer = CheckpointChoice((keeper,))
    cluster.wait(2.0)
    cluster.cut(host, seconds=4.0)
    assert assigned(cluster).snapshot_hosts == (keeper, stale)


def test_an_older_branch_in_reach_does_not_replace_the_newer_one_of_an_absent_host():
    """A former instance ran on in a partition, so its snapshot covers more cycles.

    The process waits for the replica of its last instance for one lease, as it would without any.
    """
    cluster = running(Asked(), "a", "b", "c", "d")
    former, (keeper, *_) = where(cluster), others(cluster)
    number = cluster["p"].owner
    keep(cluster, keeper, ("p", number, 4))
    cluster.cut(former, seconds=6.0)
    (last,) = set(cluster.where("p")) - {former}
    replica = next(name for name in cluster.machines if name not in (former, last))
    for name in (last, replica):
        keep(cluster, name, ("p", cluster["p"].owner, 6))
    cluster.reconnect(former, seconds=1.0)
    keep(cluster, former, ("p", number, 9))
    cluster.cut(last, replica, seconds=4.5)
    assert cluster.queue() == ["p"]
    assert "has not rejoined yet" in cluster["p"].reason
    cluster.reconnect(replica, seconds=1.0)
    assert assigned(cluster).snapshot_hosts == (replica, former)


@pytest.mark.parametrize("state", [InstanceState.WITHDRAWN, InstanceState.FENCED])
def test_a_host_that_lost_its_power_comes_after_a_newer_replica(state):
    """Its own snapshot may be older than the one that it reported before."""
    cluster = running(Asked())
    host, keeper = where(cluster), others(cluster)[0]
    number = cluster["p"].owner
    keep(cluster, keeper, ("p", number, 4))
    keep(cluster, host, ("p", number, 2))
    instance = InstanceId("p", number)
    cluster.report(host, InstanceStatus(instance, state, exit_code=-1, run_time=5.0))
    cluster.wait(1.0)
    assert assigned(cluster).instance.number > number
    assert assigned(cluster).snapshot_hosts == (keeper, host)
    said = cluster.recorded("assigned")[-1]
    assert f"its newest snapshot is cycle 4 of instance {number}, which {keeper} reported" in said


def test_a_start_asks_the_host_of_the_last_run_first_for_an_unreported_snapshot():
    """An instance may end before its slave has reported its first snapshot."""
    cluster = running(Asked())
    former, (last, stale) = where(cluster), others(cluster)
    keep(cluster, stale, ("p", cluster["p"].owner, 9))
    for name in (former, stale):
        cluster.machines[name].takes = False
    cluster.cut(former, seconds=6.0)
    assert last in cluster.where("p")
    cluster.machines[stale].takes, cluster.machines[last].takes = True, False
    cluster.machines[last].finish("p", cluster.now, code=1)
    cluster.wait(2.0)
    cluster.restart("p")
    assert assigned(cluster).snapshot_hosts == (last, stale)
