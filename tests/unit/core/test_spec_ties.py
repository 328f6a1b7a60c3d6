"""A running instance keeps the spec of its start, whichever spec its application has since."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest

from rosrm.core.master.commands import PublishStateConfig
from rosrm.core.master.state.process import ProcessPhase
from rosrm.model.orders import StopInstance
from rosrm.model.values import HostLossPolicy, MigrationPolicy, ProcessSpec, StandbyPolicy
from tests.unit.core.cluster import GIB, MIB, Cluster, Machine, job, movable, node, process
from tests.unit.core.test_applications import actions, new, program, row, state_of
from tests.unit.core.test_handoffs import stateful

ELSEWHERE = HostLossPolicy("elsewhere", 0.0)
IDLE = {"memory": 0.0, "cpu": 0.0}


def lost(spec_of: Callable[..., ProcessSpec] = process) -> Cluster:
    """Return a cluster with version 1 of `p` on a lost host, and no room for it elsewhere."""
    cluster = Cluster(Machine("b", memory=4000 * MIB))
    cluster.submit(process("big", 2400))
    cluster.wait(3.0)
    cluster.add(Machine("a", memory=4000 * MIB))
    cluster.wait(3.0)
    cluster.apply("nav", spec_of("p", 1500, host_loss=ELSEWHERE))
    cluster.wait(5.0)
    assert cluster.where("p") == ["a"]
    cluster.cut("a", seconds=30.0)
    assert cluster.phase("p") == "queued"
    return cluster


def desired(cluster: Cluster) -> ProcessSpec:
    return cluster.state.applications["nav"].specs["p"]


# --- a lost host returns ----------------------------------------------------------------------


@pytest.mark.parametrize("restarted", [False, True])
def test_a_former_version_that_returns_with_its_host_is_replaced(restarted: bool) -> None:
    """The master re-adopts the instance as the former version, and then replaces it."""
    cluster = lost()
    cluster.apply("nav", new(cluster["p"].spec))
    cluster.wait(5.0)
    if restarted:
        cluster.restart_master()
    cluster.rejoin("a", seconds=60.0)
    assert cluster.recorded("readopted")
    assert program(cluster, "p") == ("new",)
    assert (state_of(cluster), row(cluster).state) == ((2, []), "running")


def test_a_job_that_completed_on_a_lost_host_does_not_complete_its_new_version() -> None:
    """The program of the new version has not run, so the job runs again."""
    cluster = lost(job)
    cluster.apply("nav", new(cluster["p"].spec))
    cluster.machines["a"].finish("p", cluster.now, code=0, run_time=10.0)
    cluster.rejoin("a", seconds=5.0)
    assert cluster.phase("p") == "running"
    assert program(cluster, "p") == ("new",)


def test_a_process_that_has_its_version_again_is_re_adopted() -> None:
    """The instance runs the version that is desired again, so it is not interrupted."""
    cluster = lost()
    cluster.apply("nav", new(cluster["p"].spec))
    cluster.wait(1.0)
    assert cluster.apply("nav", version=1).accepted
    cluster.rejoin("a", seconds=30.0)
    assert (cluster["p"].owner, cluster.phase("p")) == (2, "running")
    assert not cluster.sent(StopInstance)


def test_a_change_in_place_during_the_loss_is_kept() -> None:
    """The re-adopted instance has the former program, and the change in place."""
    cluster = lost()
    cluster.apply("nav", replace(new(cluster["p"].spec), priority=7))
    cluster.rejoin("a", seconds=0.1)
    assert (cluster["p"].spec.priority, cluster["p"].spec.command) == (7, ("run", "it"))
    cluster.wait(30.0)
    assert cluster["p"].spec == desired(cluster)


def test_a_run_that_was_given_up_is_not_the_next_run() -> None:
    """A process that ended during the loss and is started again has no instance to re-adopt."""
    cluster = lost()
    state, former = cluster.state, cluster["p"]
    state.unqueue(former)
    state.set_phase(former, ProcessPhase.FAILED, cluster.now, "no host can start it")
    assert cluster.restart("p").accepted
    cluster.rejoin("a", seconds=30.0)
    assert cluster["p"].owner > 2


# --- needs ------------------------------------------------------------------------------------


def reserved(cluster: Cluster, host: str = "a") -> float:
    """Return the reserved memory of a host with 10 GiB, in GiB."""
    state = cluster.state
    return float(state.hosts.load[0, state.hosts.by_name[host].column]) * 10


@pytest.mark.parametrize(("before", "after"), [(1, 6), (6, 1)])
def test_changed_needs_change_the_reservation(before: int, after: int) -> None:
    """The reservation of a running process follows its spec in force, not that of its start."""
    cluster = Cluster(Machine("a", memory=10 * GIB, busy=IDLE))
    cluster.apply("nav", process("p", before * 1024))
    cluster.wait(3.0)
    cluster.apply("nav", process("p", after * 1024))
    assert reserved(cluster) == pytest.approx(after)
    cluster.restart_master()
    cluster.wait(3.0)
    assert reserved(cluster) == pytest.approx(after)


def test_changed_needs_change_the_reservation_of_a_standby() -> None:
    """The standby would run with the new needs once it takes over."""
    machines = [Machine(name, memory=10 * GIB, busy=IDLE) for name in "ab"]
    cluster = Cluster(*machines)
    spec = stateful("p", standby=StandbyPolicy(wanted=True), needs={"memory": 1.0 * GIB})
    cluster.apply("nav", spec)
    cluster.discover("p")
    cluster.wait(5.0)
    assert len(cluster["p"].instances) == 2, cluster["p"].standby_reason
    cluster.apply("nav", replace(spec, needs={"memory": 3.0 * GIB}))
    needs = [one.demand["memory"] for one in cluster.state.instances_of(cluster["p"])]
    assert needs == [3.0 * GIB] * 2


def test_the_needs_of_a_new_version_are_reserved_after_a_restart_of_the_master() -> None:
    """The destination of a replacement reserves the needs of the version that it runs."""
    cluster = Cluster(Machine("a", memory=10 * GIB, busy=IDLE))
    spec = node("p", memory=1024, migration=MigrationPolicy("relaunch"))
    cluster.apply("nav", spec)
    cluster.discover("p")
    cluster.wait(3.0)
    cluster.apply("nav", node("p", memory=4096, migration=spec.migration, command=("new",)))
    assert cluster.phase("p") == "migrating"
    assert reserved(cluster) == pytest.approx(5.0)
    cluster.restart_master()
    cluster.wait(0.3)
    assert reserved(cluster) == pytest.approx(5.0)


# --- two versions at a time -------------------------------------------------------------------


def test_the_peak_of_a_former_version_is_learned_of_its_own_program() -> None:
    """After the commit the process has another program, but the peak was of the former one."""
    cluster = Cluster("a")
    cluster.apply("nav", movable("p"))
    cluster.wait(2.0)
    cluster.machines["a"].shown["p"]["memory"] = 2.0 * GIB
    cluster.wait(1.0)
    cluster.apply("nav", new(movable("p")))
    cluster.wait(5.0)
    learned = cluster.intents["learned"]
    assert learned["run it"]["memory"] == pytest.approx(2.0 * GIB)
    assert learned.get("new", {}).get("memory", 0.0) < GIB


def test_a_placement_filter_sees_the_versions_that_run() -> None:
    """The tenants of a host have the specs of their instances."""
    cluster = Cluster("a")
    cluster.apply("nav", movable("p"))
    cluster.wait(2.0)
    cluster.apply("nav", new(movable("p")))
    cluster.wait(5.0)
    cluster.apply("nav", replace(new(movable("p")), priority=3))
    (tenant,) = cluster.state.hosts.by_name["a"].instances.values()
    assert tenant == ("p", cluster["p"].spec)


def test_each_node_of_a_handoff_is_named_by_its_own_version() -> None:
    """The new version may have another namespace."""
    cluster = Cluster("a", "b")
    spec = stateful("p", namespace="/one")
    cluster.apply("nav", spec)
    cluster.discover("p")
    cluster.wait(3.0)
    cluster.apply("nav", replace(spec, namespace="/two"))
    cluster.wait(3.0)
    sent = next(one for one in cluster.carried if isinstance(one, PublishStateConfig))
    names = sent.source_node, sent.destination_node
    assert [one.rpartition("/")[0] for one in names] == ["/one", "/two"]


# --- returns while a replacement is under way -------------------------------------------------


def moving() -> tuple[Cluster, ProcessSpec]:
    """Return a cluster in which version 2 of `p` is being started beside version 1."""
    cluster = Cluster("a")
    spec = node("p", migration=MigrationPolicy("relaunch"))
    cluster.apply("nav", spec)
    cluster.discover("p")
    cluster.wait(3.0)
    cluster.apply("nav", new(spec), process("q"))
    cluster.wait(0.3)
    assert cluster.phase("p") == "migrating"
    return cluster, spec


def test_a_return_undoes_a_replacement_that_is_under_way() -> None:
    """The former version still runs, and is not interrupted."""
    cluster, _ = moving()
    cluster.finish("q", code=1)
    cluster.wait(3.0)
    assert (state_of(cluster), row(cluster).state) == ((1, []), "running")
    assert program(cluster, "p") == ("run", "it")
    assert cluster["p"].owner == 1


def test_a_third_version_waits_for_the_second_and_replaces_it() -> None:
    """The migration that is under way ends first."""
    cluster, spec = moving()
    cluster.apply("nav", new(spec, "newest"))
    cluster.discover("p")
    cluster.wait(1.0)
    cluster.discover("p")
    cluster.wait(5.0)
    assert program(cluster, "p") == ("newest",)
    assert state_of(cluster) == (3, [])


def test_the_version_that_is_being_started_needs_no_action() -> None:
    """A plan compares with the state to which the work under way leads."""
    cluster, spec = moving()
    reply = cluster.apply("nav", new(spec), process("q"), process("r"))
    assert actions(reply) == {"r": "start"}
    plan = cluster.apply("nav", new(spec), process("q"), process("r"), process("s"), plan=True)
    assert actions(plan) == {"s": "start"}


def test_a_process_that_is_being_stopped_for_a_version_starts_with_the_newest() -> None:
    """The process does not start with the version in between."""
    cluster = Cluster(Machine("a", stubborn={"p"}))
    cluster.apply("nav", process("p"))
    cluster.wait(3.0)
    cluster.apply("nav", new(process("p")))
    cluster.wait(1.0)
    assert cluster.phase("p") == "stopping"
    cluster.apply("nav", process("p"))
    cluster.let_go("p")
    cluster.wait(5.0)
    assert program(cluster, "p") == ("run", "it")
    assert cluster.state.next_instance == 3


def test_a_version_that_fails_during_a_return_leads_to_the_version_that_returns() -> None:
    """The version that returns was the last one that was reached."""
    cluster, spec = moving()
    cluster.machines["a"].stubborn.add("p")  # so the replacement is undone later
    cluster.finish("q", code=1)
    cluster.wait(0.5)
    assert row(cluster).state == "returning"
    cluster.apply("nav", spec, process("r"))
    assert cluster.state.applications["nav"].former == 1


def test_a_process_that_is_cancelled_while_it_is_replaced_starts_again_with_its_new_version() -> (
    None
):
    """Nothing is left of the replacement."""
    cluster = Cluster(Machine("a", stubborn={"p"}))
    cluster.apply("nav", process("p"))
    cluster.wait(1.0)
    cluster.apply("nav", new(process("p")))
    cluster.cancel("p")
    cluster.let_go("p")
    assert (cluster.phase("p"), cluster["p"].next_spec) == ("cancelled", None)
    assert cluster.restart("p").accepted
    cluster.wait(1.0)
    assert program(cluster, "p") == ("new",)
