"""Host reports: invalid readings, silence, registration and departure."""

from __future__ import annotations

from dataclasses import replace
from math import inf

import numpy as np
import pytest

from rosrm.core.master import events as happened
from rosrm.core.master import listing
from rosrm.core.slave import events
from rosrm.model.orders import ReportInstances, StopInstance
from rosrm.model.values import (
    RESOURCE_SLOTS,
    Assignment,
    InstanceId,
    InstanceState,
    InstanceStatus,
    ResourceDescription,
    StopPolicy,
)
from tests.unit.core.cluster import MIB, Cluster, Machine, job, process


def usage_seen(cluster: Cluster, name: str = "a") -> float:
    return float(cluster.state.hosts.usage[0, cluster.state.hosts.by_name[name].column])


# --- readings ---------------------------------------------------------------------------------


@pytest.mark.parametrize("wrong", [float("nan"), -0.1, float("inf"), 1e6])
@pytest.mark.parametrize("what", ["usage", "limit"])
def test_an_invalid_reading_is_refused_and_recorded(what: str, wrong: float) -> None:
    """A reading with NaN, negative or absurd values is dropped, and the record names its host."""
    cluster = Cluster("a")
    values = np.full((1, RESOURCE_SLOTS), 0.3)
    values[0, 1] = wrong
    cluster.read(**{what: values})
    assert usage_seen(cluster) == pytest.approx(0.1)
    (said,) = cluster.recorded("reading_refused")
    assert said.startswith("a reading of a was refused")


def test_a_host_with_invalid_readings_gets_no_work_and_is_not_lost() -> None:
    """Its last valid reading grows stale, but each message renews the last contact."""
    cluster = Cluster("a")
    nonsense = np.full((1, RESOURCE_SLOTS), np.nan)
    for _ in range(150):
        cluster.now += 0.1
        cluster.read(usage=nonsense)
        cluster.tell(happened.TimePassed())
    cluster.submit(process("p"))
    assert cluster.queue() == ["p"]
    assert not cluster.recorded("host_lost")
    (verdict,) = cluster.explain("p")["decision"]["hosts"]
    assert verdict["reason"] == "its reading of memory, cpu is stale"
    assert len(cluster.recorded("reading_refused")) == 2  # recorded now and then, not each time
    cluster.read()
    cluster.settle()
    assert cluster.where("p") == ["a"]


def test_an_invalid_reading_affects_no_other_host_of_its_batch() -> None:
    """The valid readings of the batch are used."""
    cluster = Cluster("a", "b")
    usage = np.full((2, RESOURCE_SLOTS), 0.4)
    usage[0, 0] = np.nan
    cluster.read(usage=usage)
    assert usage_seen(cluster, "a") == pytest.approx(0.1)
    assert usage_seen(cluster, "b") == pytest.approx(0.4)


def test_a_reading_that_comes_late_does_not_replace_a_newer_one() -> None:
    """Messages may overtake each other."""
    cluster = Cluster("a")
    machine = cluster.machines["a"]
    late = cluster.readings([machine])
    machine.busy["memory"] = 0.5
    cluster.read()
    cluster.tell(late)
    assert usage_seen(cluster) == pytest.approx(0.5)


def test_a_reading_of_an_unknown_slave_is_ignored() -> None:
    """A reading of a former run of a slave, or of an unassigned host number, is ignored."""
    cluster = Cluster("a")
    for wrong in ({"incarnation": np.array([99], np.uint64)}, {"host_id": np.array([7])}):
        cluster.read(usage=np.full((1, RESOURCE_SLOTS), 0.5), **wrong)
    assert usage_seen(cluster) == pytest.approx(0.1)


def test_a_stale_reading_closes_its_host_and_is_never_zero() -> None:
    """With a late probe the host takes no work, and its usage stays as last measured."""
    cluster = Cluster("a", "b")
    cluster.machines["a"].stale.add("memory")
    cluster.read()
    cluster.submit(process("p"), process("q"))
    assert cluster.counts() == {"a": 0, "b": 2}
    assert usage_seen(cluster) == pytest.approx(0.1)


def test_a_stale_reading_without_a_limit_closes_nothing() -> None:
    """A late probe of an unlimited resource does not keep work from the host."""
    resources = (ResourceDescription("memory", "B", 1e9), ResourceDescription("fan", "1", 1.0))
    cluster = Cluster(Machine("a", resources=resources))
    cluster.machines["a"].stale.add("fan")
    cluster.read()
    cluster.submit(process("p"))
    assert cluster.where("p") == ["a"]


def test_the_registration_of_a_host_defines_the_meaning_of_its_slots() -> None:
    """Hosts may have different resources, in any order."""
    memory, cpu = ResourceDescription("memory", "B", 1e9), ResourceDescription("cpu", "core", 4.0)
    cluster = Cluster(
        Machine("a", resources=(memory, cpu), busy={"memory": 0.2, "cpu": 0.3}),
        Machine("b", resources=(cpu, memory), busy={"memory": 0.4, "cpu": 0.5}),
        Machine("c", resources=(cpu,), busy={"cpu": 0.6}),
    )
    cluster.read()
    usage = cluster.state.hosts.usage[:, :3].T
    assert usage == pytest.approx(np.array([[0.2, 0.3], [0.4, 0.5], [np.nan, 0.6]]), nan_ok=True)


def test_an_invalid_usage_is_refused() -> None:
    """An invalid usage of an instance is recorded, and its last valid usage stays."""
    cluster = Cluster("a").with_processes(process("p", memory=100))
    for wrong in (float("nan"), -1.0, float("inf")):
        cluster.machines["a"].shown["p"] = {"memory": wrong}
        cluster.tell(cluster.machines["a"].usages(cluster.now))
    assert cluster.state.instances[1].seen == {}
    assert cluster.recorded("reading_refused") == [
        "a usage of p#1 was refused (NaN, negative or absurd)"
    ]


# --- registration -----------------------------------------------------------------------------


def test_a_second_live_slave_of_a_name_is_refused() -> None:
    """The refusal names the first slave, which is unchanged."""
    cluster = Cluster("a")
    second = replace(cluster.machines["a"].description(), incarnation=77)
    reply = cluster.ask(happened.HostRegistered, second, ())
    assert (reply.accepted, reply.code) == (False, "name_taken")
    assert "pid 7 on a.local" in reply.message
    cluster.ask(happened.HostRegistered, second, ())  # a retry shortly afterwards
    assert len(cluster.recorded("host_refused")) == 1
    cluster.submit(process("p"))
    assert cluster.where("p") == ["a"]


@pytest.mark.parametrize("seconds", [1.5, 11.0], ids=["silent", "lost"])
def test_the_next_run_of_a_slave_registers_when_the_former_is_silent(seconds: float) -> None:
    """The instances of the old slave keep running; after a loss they are re-adopted."""
    cluster = Cluster("a").with_processes(process("p"))
    cluster.cut("a", seconds=seconds)
    cluster.restart_slave("a")
    assert cluster.phase("p") == "running"
    assert len(cluster.assigned()) == 1


def test_a_repeated_registration_changes_nothing() -> None:
    """The first answer may have been lost; an assignment on its way is not given twice."""
    cluster = Cluster("a", "b")
    machine = cluster.machines["a"]
    again = happened.HostRegistered(901, machine.description(), ())
    cluster.machines["b"].takes = False
    cluster.read()
    cluster.decide(happened.SubmissionReceived(902, (process("p"), process("q"))))
    cluster.tell(again)
    assert cluster.replies[901].accepted
    assert cluster.replies[901].host_id == machine.host_id
    assert [cluster.phase(name) for name in "pq"] == ["assigned", "assigned"]
    assert not cluster.recorded("queued")


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"resources": (ResourceDescription("memory", "B", 0.0),)}, "a number above 0"),
        ({"resources": (ResourceDescription("memory", "B", float("nan")),)}, "a number above 0"),
        ({"resources": (ResourceDescription("x", "1", 1.0),) * 2}, "twice"),
        (
            {"resources": tuple(ResourceDescription(f"r{i}", "1", 1.0) for i in range(17))},
            "16 are the most",
        ),
        ({"name": ""}, "needs a name"),
        ({"incarnation": 0}, "incarnation"),
    ],
)
def test_an_invalid_description_is_refused(change: dict, said: str) -> None:
    """The description is checked before any part of it is used."""
    cluster = Cluster()
    description = replace(Machine("a", incarnation=5).description(), **change)
    reply = cluster.ask(happened.HostRegistered, description, ())
    assert not reply.accepted
    assert said in reply.message
    assert not len(cluster.state.hosts)


def test_a_request_of_an_unregistered_host_is_refused() -> None:
    """A request for work or a departure of an unknown host is answered."""
    cluster = Cluster()
    for kind in (happened.ProcessRequested, happened.HostLeft):
        assert cluster.ask(kind, 3, 4).code == "unknown"


def test_the_arrays_grow_without_loss() -> None:
    """The arrays grow without loss."""
    cluster = Cluster()
    for i in range(11):
        resources = (
            ResourceDescription("memory", "B", 1e9), ResourceDescription(f"extra{i}", "1", 1.0),
        )  # fmt: skip
        cluster.add(Machine(f"h{i}", resources=resources, busy={"memory": 0.01 * i}))
        cluster.submit(process(f"p{i}", needs={"memory": 1.0, f"extra{i}": 0.2}))
    for i in range(11):
        assert cluster.where(f"p{i}") == [f"h{i}"]
        assert usage_seen(cluster, f"h{i}") == pytest.approx(0.01 * i)
    load = cluster.state.hosts.load
    assert [load[1 + i, i] for i in range(11)] == pytest.approx([0.2] * 11)


# --- liveness ---------------------------------------------------------------------------------


def test_a_silent_host_is_suspect_and_gets_no_work() -> None:
    """The processes of a suspect host keep running."""
    cluster = Cluster("a").with_processes(process("p"))
    cluster.cut("a", seconds=1.2)
    assert len(cluster.recorded("host_suspect")) == 1
    cluster.submit(process("q"))
    assert (cluster.phase("p"), cluster.phase("q")) == ("running", "queued")
    cluster.reconnect("a", seconds=0.3)
    assert cluster.recorded("host_back") == ["a reports again"]
    assert cluster.where("q") == ["a"]


def test_a_host_whose_key_was_revoked_gets_no_work() -> None:
    """The master keeps its processes until the lease ends, because the slave obeys its fences."""
    cluster = Cluster("a").with_processes(process("before"))
    cluster.tell(happened.KeyRevoked(1, cluster.machines["a"].incarnation + 1))
    assert not cluster.recorded("peer_refused")  # another run of the slave, with a new key
    cluster.tell(happened.KeyRevoked(1, cluster.machines["a"].incarnation))
    assert "host:a was refused: its key was revoked" in cluster.recorded("peer_refused")[0]
    cluster.submit(process("after"))
    assert cluster.queue() == ["after"]
    assert cluster.phase("before") == "running"
    cluster.cut("a", seconds=2.0)
    assert cluster.restart_slave("a").accepted
    cluster.settle()
    assert cluster.queue() == []


def test_the_next_loss_is_the_end_of_the_lease_of_the_most_silent_host() -> None:
    """The master awaits this moment, so that a loss is noticed when the lease ends."""
    cluster = Cluster("a", "b", lease=10.0)
    assert cluster.state.next_loss == inf
    cluster.wait(1.0)
    cluster.cut("a", seconds=2.0)
    ends = float(cluster.state.hosts.last_contact[cluster.state.hosts.by_name["a"].column]) + 10.0
    assert cluster.state.next_loss == ends < cluster.now + 9.0
    cluster.now = ends
    cluster.read(cluster.machines["b"])
    cluster.tell(happened.TimePassed())
    assert len(cluster.recorded("host_lost")) == 1
    assert cluster.state.next_loss == ends + 10.0


def test_a_host_with_a_long_period_is_not_silent() -> None:
    """The host is suspect after three of its own periods, and its lease grows by the same time."""
    cluster = Cluster(Machine("slow", period=4.0), "quick", suspect=1.0, lease=10.0)
    for name in cluster.machines:
        cluster.machines[name].connected = False
    cluster.wait(11.9)
    assert [told.split()[0] for told in cluster.recorded("host_suspect")] == ["quick"]
    assert [told.split()[0] for told in cluster.recorded("host_lost")] == ["quick"]
    cluster.wait(0.3)
    assert cluster.recorded("host_suspect")[-1].startswith(
        "slow is suspect: it has not reported for 12."
    )
    cluster.wait(8.6)
    assert len(cluster.recorded("host_lost")) == 1
    cluster.wait(0.4)
    assert cluster.recorded("host_lost")[-1].startswith("slow is lost: it has not reported for 21.")


def test_the_processes_of_a_lost_host_are_readopted() -> None:
    """The processes return to their former phases, and the master requests a full report."""
    cluster = Cluster("a").with_processes(process("p"), job("q"))
    cluster.cut("a", seconds=11.0)
    cluster.machines["a"].finish("q", cluster.now)
    cluster.reconnect("a", seconds=0.5)
    assert (cluster.phase("p"), cluster.phase("q")) == ("running", "finished")
    assert len(cluster.orders(ReportInstances)) == 1


@pytest.mark.parametrize("last", [False, True])
def test_after_a_lost_status_batch_the_master_requests_a_full_report(last: bool) -> None:
    """A gap in the batch numbers shows the loss, and of the last batch the next reading does."""
    cluster = Cluster("a").with_processes(job("p"), process("q"))
    machine = cluster.machines["a"]
    machine.finish("p", cluster.now)
    machine.status_batches.clear()
    if last:
        cluster.wait(2.0)
    else:
        cluster.finish("q")
    assert (cluster.phase("p"), cluster.phase("q")) == (
        "finished",
        "running" if last else "finished",
    )
    assert len(cluster.orders(ReportInstances)) == 1


def test_a_status_batch_that_comes_late_or_twice_changes_nothing() -> None:
    """The master already knows a newer status."""
    cluster = Cluster("a").with_processes(process("p"))
    machine = cluster.machines["a"]
    old = happened.StatusesReceived(machine.host_id, machine.incarnation, 1, True, ())
    before = len(cluster.carried)
    cluster.tell(old)
    cluster.settle()
    assert cluster.phase("p") == "running"
    assert len(cluster.carried) == before


# --- cordon, drain, leave ---------------------------------------------------------------------


def test_a_cordoned_host_gets_no_work_and_keeps_what_it_has() -> None:
    """The host takes work again once it is uncordoned."""
    cluster = Cluster("a", Machine("b", busy={"memory": 0.5})).with_processes(process("p"))
    assert cluster.set_host("a", "cordon").message == "a is cordoned"
    cluster.submit(process("q"))
    assert (cluster.where("p"), cluster.where("q")) == (["a"], ["b"])
    cluster.set_host("a", "uncordon")
    cluster.submit(process("r"))
    assert cluster.where("r") == ["a"]


def test_the_refusal_of_an_unknown_host_or_action_lists_the_known_ones() -> None:
    """The answer names the known hosts or actions."""
    cluster = Cluster("a", "b")
    said = cluster.set_host("c", "cordon").message
    assert said == "no such host: 'c'; there are: a, b (`rosrm hosts` lists them)"
    assert "cordon, uncordon, drain" in cluster.set_host("a", "explode").message


def test_the_processes_that_a_leaving_host_ends_are_queued_again() -> None:
    """A service that exits with 0 on its slave's signal is queued again, too."""
    cluster = Cluster("a", Machine("b", busy={"memory": 0.5}))
    cluster.submit(process("p"), job("q"))
    assert cluster.counts() == {"a": 2, "b": 0}
    cluster.leave("a")
    assert cluster.counts() == {"a": 0, "b": 2}
    assert cluster.recorded("host_left") == ["a leaves: its slave stops"]


def test_a_job_that_completes_as_its_host_leaves_has_finished() -> None:
    """The job completed by its own exit and does not run again."""
    cluster = Cluster("a", Machine("b", busy={"memory": 0.5})).with_processes(job("p"))
    machine = cluster.machines["a"]
    cluster.ask(happened.HostLeft, machine.host_id, machine.incarnation)
    machine.finish("p", cluster.now)
    cluster.settle()
    assert cluster.phase("p") == "finished"


def test_a_process_that_a_stopped_slave_ends_has_the_reason_and_the_time() -> None:
    """A bare "SIGINT" would not tell the user the cause, nor whether the process ever ends."""
    cluster = Cluster("a").with_processes(process("deaf", stop=StopPolicy(2.0, 3.0)))
    machine = cluster.machines["a"]
    cluster.ask(happened.HostLeft, machine.host_id, machine.incarnation, settle=False)
    (instance,) = machine.programs
    status = InstanceStatus(instance, InstanceState.STOPPING, pid=7, message="SIGINT")
    cluster.report("a", status)
    row = listing.process_row(cluster.state, cluster["deaf"], cluster.now)
    assert row.state == "stopping"
    assert row.reason == "the slave of a was stopped; SIGINT; SIGKILL after 5 s"


def test_a_host_that_left_and_became_silent_is_lost() -> None:
    """Its processes stay in memory and show as unreachable."""
    cluster = Cluster("a", "b").with_processes(process("p"))
    machine = cluster.machines["a"]
    cluster.ask(happened.HostLeft, machine.host_id, machine.incarnation)
    machine.connected = False
    cluster.wait(11.0)
    assert cluster.phase("p") == "unreachable"


def test_a_host_that_left_rejoins_by_a_registration() -> None:
    """A new run of its slave registers."""
    cluster = Cluster("a")
    cluster.leave("a")
    cluster.submit(process("p"))
    assert cluster.queue() == ["p"]
    cluster.restart_slave("a")
    assert cluster.where("p") == ["a"]


def test_an_unknown_instance_is_ordered_to_stop_until_it_has_ended() -> None:
    """The slave receives a stop order for an unknown instance, and again after each time-out."""
    cluster = Cluster("a")
    machine = cluster.machines["a"]
    machine.stubborn.add("ghost")
    spec = process("ghost", memory=10 * MIB)
    ghost = Assignment(InstanceId("ghost", 999), spec, 1, "ghost")
    machine.tell(events.AssignmentsReceived((ghost,)), cluster.now)
    cluster.settle()
    cluster.wait(5.0)
    assert len(cluster.orders(StopInstance)) == 3
    assert cluster.submit(process("ghost")).accepted
    cluster.wait(0.5)
    assert cluster["ghost"].reason == "waits until ghost#999 on a has ended"
    machine.let_go("ghost", cluster.now)
    cluster.wait(0.5)
    assert cluster.phase("ghost") == "running"
    assert not cluster.state.strays
