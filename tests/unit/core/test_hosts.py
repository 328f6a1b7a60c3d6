"""Host reports: invalid readings, silence, registration and departure."""

from __future__ import annotations

from dataclasses import replace

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
def test_a_reading_that_makes_no_sense_is_refused_and_said(what: str, wrong: float) -> None:
    """A reading with NaN, negative or absurd values is dropped, and the record names its host."""
    cluster = Cluster("a")
    values = np.full((1, RESOURCE_SLOTS), 0.3)
    values[0, 1] = wrong
    cluster.read(**{what: values})
    assert usage_seen(cluster) == pytest.approx(0.1)
    (said,) = cluster.recorded("reading_refused")
    assert said.startswith("a reading of a was refused")


def test_a_host_that_talks_nonsense_gets_no_work_and_is_not_lost() -> None:
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


def test_one_host_of_a_batch_that_talks_nonsense_harms_no_other() -> None:
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


def test_a_reading_of_a_stranger_is_ignored() -> None:
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


def test_hosts_with_different_resources_in_different_slots_are_told_apart() -> None:
    """The registration of a host defines the meaning of its slots."""
    memory, cpu = ResourceDescription("memory", "B", 1e9), ResourceDescription("cpu", "core", 4.0)
    cluster = Cluster(
        Machine("a", resources=(memory, cpu), busy={"memory": 0.2, "cpu": 0.3}),
        Machine("b", resources=(cpu, memory), busy={"memory": 0.4, "cpu": 0.5}),
        Machine("c", resources=(cpu,), busy={"cpu": 0.6}),
    )
    cluster.read()
    usage = cluster.state.hosts.usage
    assert usage[:, 0] == pytest.approx([0.2, 0.3])
    assert usage[:, 1] == pytest.approx([0.4, 0.5])
    assert usage[:, 2] == pytest.approx([np.nan, 0.6], nan_ok=True)


def test_a_usage_that_makes_no_sense_is_refused() -> None:
    """An invalid usage of an instance is recorded, and its last valid usage stays."""
    cluster = Cluster("a")
    cluster.submit(process("p", memory=100))
    for wrong in (float("nan"), -1.0, float("inf")):
        cluster.machines["a"].shown["p"] = {"memory": wrong}
        cluster.tell(cluster.machines["a"].usages(cluster.now))
    assert cluster.state.instances[1].seen == {}
    assert cluster.recorded("reading_refused") == ["a usage of p#1 was refused (NaN or negative)"]


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


def test_a_new_run_of_a_slave_is_taken_in_when_the_old_one_is_silent() -> None:
    """The instances of the old slave keep running."""
    cluster = Cluster("a")
    cluster.submit(process("p"))
    machine = cluster.machines["a"]
    machine.connected = False
    cluster.wait(1.5)
    machine.restart_slave(cluster.now)
    machine.connected = True
    cluster.register(machine)
    cluster.wait(0.5)
    assert cluster.phase("p") == "running"
    assert len(cluster.assigned()) == 1


def test_a_registration_that_comes_twice_changes_nothing() -> None:
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
def test_a_description_that_makes_no_sense_is_refused(change: dict, said: str) -> None:
    """The description is checked before any part of it is used."""
    cluster = Cluster()
    description = replace(Machine("a", incarnation=5).description(), **change)
    reply = cluster.ask(happened.HostRegistered, description, ())
    assert not reply.accepted
    assert said in reply.message
    assert not len(cluster.state.hosts)


def test_a_host_that_was_never_registered_is_told_so() -> None:
    """A request for work or a departure of an unknown host is answered."""
    cluster = Cluster()
    for kind in (happened.ProcessRequested, happened.HostLeft):
        assert cluster.ask(kind, 3, 4).code == "unknown"


def test_more_hosts_and_resources_than_at_first_keep_everything() -> None:
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
    cluster = Cluster("a")
    cluster.submit(process("p"))
    cluster.cut("a", seconds=1.2)
    assert len(cluster.recorded("host_suspect")) == 1
    cluster.submit(process("q"))
    assert (cluster.phase("p"), cluster.phase("q")) == ("running", "queued")
    cluster.reconnect("a", seconds=0.3)
    assert cluster.recorded("host_back") == ["a reports again"]
    assert cluster.where("q") == ["a"]


def test_a_host_that_reports_slowly_by_its_own_word_is_not_silent() -> None:
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


def test_a_host_that_is_silent_past_its_lease_is_lost() -> None:
    """Its processes are unreachable, not ended, and have no successors."""
    cluster = Cluster("a", "b", lease=10.0)
    cluster.machines["b"].busy["memory"] = 0.5
    cluster.read()
    cluster.submit(process("p"))
    cluster.cut("a", seconds=11.0)
    (said,) = cluster.recorded("host_lost")
    assert said.startswith("a is lost: it has not reported for 10.")
    assert (cluster.phase("p"), cluster["p"].reason) == ("unreachable", "a is lost")
    assert cluster.where("p") == ["a"]


def test_a_lost_host_that_comes_back_brings_its_processes_along() -> None:
    """The processes return to their former phases, and the master requests a full report."""
    cluster = Cluster("a")
    cluster.submit(process("p"), job("q"))
    machine = cluster.machines["a"]
    machine.connected = False
    cluster.wait(11.0)
    machine.finish("q", cluster.now)
    machine.connected = True
    cluster.wait(0.5)
    assert (cluster.phase("p"), cluster.phase("q")) == ("running", "finished")
    assert len(cluster.orders(ReportInstances)) == 1


def test_a_lost_host_whose_slave_was_restarted_brings_its_processes_along() -> None:
    """A new registration restores the processes, too."""
    cluster = Cluster("a")
    cluster.submit(process("p"))
    machine = cluster.machines["a"]
    machine.connected = False
    cluster.wait(11.0)
    machine.restart_slave(cluster.now)
    machine.connected = True
    cluster.register(machine)
    assert cluster.phase("p") == "running"
    assert len(cluster.assigned()) == 1


def test_a_status_batch_that_was_missed_makes_the_master_ask_for_everything() -> None:
    """A gap in the batch numbers shows the loss."""
    cluster = Cluster("a")
    cluster.submit(job("p"), process("q"))
    machine = cluster.machines["a"]
    machine.finish("p", cluster.now)
    machine.said.clear()
    machine.finish("q", cluster.now)
    cluster.settle()
    assert (cluster.phase("p"), cluster.phase("q")) == ("finished", "finished")
    assert len(cluster.orders(ReportInstances)) == 1


def test_the_last_status_batch_is_missed_by_what_the_reading_says() -> None:
    """The reading has the number of batches sent, so a lost last batch is noticed."""
    cluster = Cluster("a")
    cluster.submit(job("p"))
    machine = cluster.machines["a"]
    machine.finish("p", cluster.now)
    machine.said.clear()
    cluster.wait(2.0)
    assert cluster.phase("p") == "finished"


def test_a_status_batch_that_comes_late_or_twice_changes_nothing() -> None:
    """The master already knows a newer status."""
    cluster = Cluster("a")
    cluster.submit(process("p"))
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
    cluster = Cluster("a", Machine("b", busy={"memory": 0.5}))
    cluster.submit(process("p"))
    assert cluster.set_host("a", "cordon").message == "a is cordoned"
    cluster.submit(process("q"))
    assert (cluster.where("p"), cluster.where("q")) == (["a"], ["b"])
    cluster.set_host("a", "uncordon")
    cluster.submit(process("r"))
    assert cluster.where("r") == ["a"]


def test_an_unknown_host_or_action_is_refused_with_what_there_is() -> None:
    """The answer names the known hosts or actions."""
    cluster = Cluster("a", "b")
    said = cluster.set_host("c", "cordon").message
    assert said == "no such host: 'c'; there are: a, b (`rosrm hosts` lists them)"
    assert "cordon, uncordon, drain" in cluster.set_host("a", "explode").message


def test_what_a_host_ends_as_it_leaves_returns_to_the_queue() -> None:
    """A service that exits with 0 on its slave's signal is queued again, too."""
    cluster = Cluster("a", Machine("b", busy={"memory": 0.5}))
    cluster.submit(process("p"), job("q"))
    assert cluster.counts() == {"a": 2, "b": 0}
    cluster.leave("a")
    assert cluster.counts() == {"a": 0, "b": 2}
    assert cluster.recorded("host_left") == ["a leaves: its slave stops"]


def test_a_job_that_completes_as_its_host_leaves_has_finished() -> None:
    """The job completed by its own exit and does not run again."""
    cluster = Cluster("a", Machine("b", busy={"memory": 0.5}))
    cluster.submit(job("p"))
    machine = cluster.machines["a"]
    cluster.ask(happened.HostLeft, machine.host_id, machine.incarnation)
    machine.finish("p", cluster.now)
    cluster.settle()
    assert cluster.phase("p") == "finished"


def test_what_a_slave_that_was_stopped_still_ends_says_so_and_how_long() -> None:
    """A bare "SIGINT" would not tell the user the cause, nor whether the process ever ends."""
    cluster = Cluster("a")
    cluster.submit(process("deaf", stop=StopPolicy(2.0, 3.0)))
    machine = cluster.machines["a"]
    cluster.ask(happened.HostLeft, machine.host_id, machine.incarnation, settle=False)
    (instance,) = machine.programs
    status = InstanceStatus(instance, InstanceState.STOPPING, pid=7, message="SIGINT")
    cluster.tell(
        happened.StatusesReceived(
            machine.host_id, machine.incarnation, machine.sequence + 1, False, (status,)
        )
    )
    row = listing.process_row(cluster.state, cluster["deaf"], cluster.now)
    assert row.state == "stopping"
    assert row.reason == "the slave of a was stopped; SIGINT; SIGKILL after 5 s"


def test_a_host_that_left_and_says_no_more_is_lost_with_what_it_held() -> None:
    """Its processes stay in memory and show as unreachable."""
    cluster = Cluster("a", "b")
    cluster.submit(process("p"))
    machine = cluster.machines["a"]
    cluster.ask(happened.HostLeft, machine.host_id, machine.incarnation)
    machine.connected = False
    cluster.wait(11.0)
    assert cluster.phase("p") == "unreachable"


def test_a_host_that_left_comes_back_by_registering() -> None:
    """A new run of its slave registers."""
    cluster = Cluster("a")
    cluster.leave("a")
    cluster.submit(process("p"))
    assert cluster.queue() == ["p"]
    cluster.machines["a"].restart_slave(cluster.now)
    cluster.register(cluster.machines["a"])
    assert cluster.where("p") == ["a"]


def test_an_instance_that_nobody_intends_is_stopped_until_it_has_ended() -> None:
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
    reply = cluster.submit(process("ghost"))
    assert not reply.accepted
    assert "an earlier ghost#999 is still being stopped on a" in reply.message
    machine.let_go("ghost", cluster.now)
    cluster.settle()
    assert cluster.submit(process("ghost")).accepted
    assert not cluster.state.unowned_instances
