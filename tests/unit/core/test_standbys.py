"""Standbys: one shadow on another host, which takes over when the primary ends."""

from __future__ import annotations

from collections import deque
from dataclasses import replace
from typing import Any
from unittest.mock import ANY

import pytest

from rosrm.core.master import events as happened
from rosrm.core.master.invariants import check
from rosrm.model.orders import AmendInstance, FenceInstance, StartInstance
from rosrm.model.plan import Configure, HandoffPhase, ReportPhase
from rosrm.model.values import (
    HostLossPolicy,
    InstanceId,
    InstanceState,
    Limits,
    RestartPolicy,
    StandbyPolicy,
)
from tests.unit.core.cluster import Cluster, Machine
from tests.unit.core.test_handoffs import stateful

STANDBY = StandbyPolicy(wanted=True)


def with_standby(*others: str, quirk: str = "", seconds: float = 11.0, **fields: Any) -> Cluster:
    """Return a cluster where p runs on a and has a standby on b or another host.

    Args:
        others: names of the other hosts.
        quirk: violation of the protocol by the standby on b.
        seconds: time after the submission. After 11 s the lease of a lost host may expire.
    """
    cluster = Cluster("a", *(Machine(name, busy={"memory": 0.5}) for name in others or ("b",)))
    cluster.machines["b"].quirks["p"] |= {quirk} - {""}
    cluster.wait(0.5)
    cluster.submit(stateful(standby=STANDBY, **fields))
    cluster.wait(seconds)
    return cluster


def standby_of(cluster: Cluster) -> str:
    """Return the host of the standby of p."""
    (host,) = [name for name in cluster.where("p") if name != "a"]
    return host


def moving_to_an_unready_host() -> Cluster:
    """Return a cluster where p moves to the host without its standby, which is never ready."""
    cluster = with_standby("b", "c")
    other = "c" if standby_of(cluster) == "b" else "b"
    cluster.machines[other].quirks["p"].add("never ready")
    cluster.migrate("p", other)
    return cluster


def lose(cluster: Cluster, name: str, seconds: float = 12.0) -> None:
    """Cut a host off for longer than its lease."""
    cluster.cut(name, seconds=seconds)


def test_a_process_gets_a_standby_on_another_host() -> None:
    """The standby is silent and ready, and is recorded."""
    cluster = with_standby()
    assert (cluster.where("p"), cluster.active()) == (["a", "b"], ["a"])
    assert cluster.recorded("standby_ready") == ["the standby of p is ready on b"]
    assert cluster.explain("p")["reason"] == ""
    assert (cluster.phase("p"), cluster["p"].owner) == ("running", 1)


def test_a_standby_waits_for_a_second_host_with_one_record() -> None:
    """The process itself keeps running."""
    cluster = Cluster("a").with_processes(stateful(standby=STANDBY))
    cluster.wait(30.0)
    assert cluster.recorded("standby_waits") == ["p: no host has room for its standby"]
    assert cluster.phase("p") == "running"
    assert cluster.explain("p")["reason"] == "no host has room for its standby"
    cluster.add("b")
    cluster.wait(4.0)
    assert cluster.active() == ["a"]
    assert cluster.where("p") == ["a", "b"]


def test_standbys_begin_in_the_order_of_submission() -> None:
    """A replay numbers their instances alike, with any hash seed of Python."""
    names = [f"p{number}" for number in range(8)]
    cluster = Cluster("a").with_processes(*(stateful(name, standby=STANDBY) for name in names))
    cluster.wait(1.0)
    cluster.add("b")
    cluster.wait(8.0)
    begun = [record.process for record in cluster.records if record.kind == "standby_begun"]
    assert begun == names


@pytest.mark.parametrize("then", ["wait", "elsewhere"])
def test_the_standby_takes_over_when_the_host_is_lost(then: str) -> None:
    """Under every host-loss policy the standby takes over at once; the primary is fenced later.

    The next standby is on a third host, or on the first one after its rejoin.
    """
    cluster = with_standby(host_loss=HostLossPolicy(then))
    lose(cluster, "a", 10.5)
    assert (cluster.phase("p"), cluster.active()) == ("running", ["a", "b"])
    assert cluster["p"].owner == 2
    assert "is ready" not in cluster.explain("p")["reason"]  # that one is the owner now
    cluster.reconnect("a", seconds=0.3)
    assert cluster.active() == ["b"]
    cluster.wait(5.0)
    assert (cluster.active(), cluster.where("p")) == (["b"], ["a", "b"])
    assert len(cluster.recorded("standby_ready")) == 2


@pytest.mark.parametrize("when", ["never", "on-failure"])
def test_the_standby_takes_over_when_the_primary_crashes(when: str) -> None:
    """Under every restart policy the standby takes over, and the primary is not restarted."""
    cluster = with_standby(restart=RestartPolicy(when))
    machine = cluster.machines["a"]
    if when == "on-failure":  # its supervisor waits before the restart
        status = machine.slave.held[machine.find("p")].status
        del machine.programs[machine.find("p")]
        machine.ends[status.instance] = status
        for state in (InstanceState.BACKOFF, InstanceState.EXITED):
            machine._supervisor_says(replace(status, state=state, pid=0), cluster.now)
            cluster.settle()
    else:
        cluster.finish("p", code=3)
    assert (cluster.phase("p"), cluster.active(), cluster["p"].owner) == ("running", ["b"], 2)
    assert "takes over" in cluster.recorded("failed_over")[0]


def test_a_standby_with_a_state_takes_over_before_it_is_ready() -> None:
    """Each snapshot is older, and a reader that ended with the primary would delay it for long."""
    cluster = with_standby(quirk="never ready", host_loss=HostLossPolicy("elsewhere"))
    assert not cluster.recorded("standby_ready")
    lose(cluster, "a")
    assert (cluster.phase("p"), cluster.active(), cluster["p"].owner) == ("running", ["a", "b"], 2)
    assert "takes over" in cluster.recorded("failed_over")[0]


def test_a_standby_without_a_state_does_not_take_over() -> None:
    """The process is queued again, after the shadow was stopped."""
    cluster = with_standby(quirk="no state", host_loss=HostLossPolicy("elsewhere"))
    lose(cluster, "a")
    assert (cluster.phase("p"), cluster.active()) == ("running", ["a", "b"])
    assert cluster["p"].owner == cluster.machines["b"].find("p").number
    assert not cluster.recorded("failed_over")


def test_a_standby_that_is_never_ready_is_kept() -> None:
    """The primary may be silent for long, so the wait for its state has no time-out."""
    cluster = with_standby(quirk="never ready", seconds=200.0)
    assert cluster.where("p") == ["a", "b"]
    assert not cluster.recorded("standby_lost")
    assert cluster.explain("p")["reason"] == (
        "its standby on b is not ready: p#2 receives the state of the source: waits for input "
        "/scan; p#1 takes part in the handoff"
    )


def test_a_standby_that_does_not_start_in_time_is_replaced() -> None:
    """Its slave does not receive the order, which is repeated until the time-out."""
    cluster = with_standby(seconds=0.0)
    cluster.machines["b"].ordered = deque(maxlen=0)
    cluster.wait(60.0)
    assert len(cluster.orders(StartInstance)) > 2
    assert "p has no standby: p#2 did not start in time; the master starts another one in 2 s" in (
        cluster.recorded("standby_lost")
    )


def test_a_primary_keeps_its_restarts_beside_its_standby() -> None:
    """The plan is paused before SWITCH, and its step that suspends them is left out until then."""
    cluster = with_standby()
    assert not cluster.orders(AmendInstance)
    assert cluster.state.standbys["p"].current_step == Configure(HandoffPhase.SWITCH, ANY, undo=ANY)
    assert not cluster.recorded("migration_step")


def test_a_standby_takes_over_with_what_has_changed_since_its_start() -> None:
    """Its plan has the restart policy and limits of that time."""
    cluster = Cluster("a", Machine("b", busy={"memory": 0.5}))
    cluster.apply("nav", stateful(standby=STANDBY))
    cluster.wait(11.0)
    policy, limits = RestartPolicy("never"), Limits(memory=2e9)
    cluster.apply("nav", stateful(standby=STANDBY, restart=policy, limits=limits))
    cluster.wait(3.0)
    cluster.machines["a"].finish("p", cluster.now, code=3)
    cluster.wait(5.0)
    program = cluster.machines["b"].programs[InstanceId("p", cluster["p"].owner)]
    assert (program.restart, program.limits) == (policy, limits)


def test_the_end_of_a_standby_is_reported_with_its_cause() -> None:
    """The event quotes the exit status of the standby."""
    cluster = with_standby()
    cluster.machines["b"].finish("p", cluster.now, code=3)
    cluster.wait(1.0)
    (lost,) = cluster.recorded("standby_lost")
    assert lost.startswith("p has no standby: p#2 ended: exit code 3"), lost


def test_a_standby_that_failed_is_replaced_after_a_delay() -> None:
    """The delay grows with each failed standby."""
    cluster = with_standby(seconds=5.0)
    cluster.node(standby_of(cluster)).say(ReportPhase.FAILED, "another run of the source")
    cluster.wait(1.0)
    assert cluster.where("p") == cluster.active()
    assert cluster.recorded("standby_lost") == [
        "p has no standby: another run of the source; the master starts another one in 2 s"
    ]
    cluster.wait(5.0)
    assert len(cluster.where("p")) == 2


def test_the_host_of_the_standby_differs_in_a_label() -> None:
    """Another rack qualifies; a host without the label does not."""
    cluster = Cluster(Machine("a", labels={"rack": "1"}))
    cluster.submit(stateful(standby=StandbyPolicy(True, ("rack",))))
    cluster.add(Machine("b", labels={"rack": "1"}))
    cluster.add(Machine("c"))
    cluster.wait(5.0)
    assert cluster.where("p") == ["a"]
    cluster.add(Machine("d", labels={"rack": "2"}))
    cluster.wait(5.0)
    assert cluster.where("p") == ["a", "d"]


def test_a_move_replaces_the_standby() -> None:
    """The old standby followed the source, so the destination gets a new one."""
    cluster = with_standby("b", "c")
    assert cluster.migrate("p").accepted
    cluster.wait(8.0)
    assert len(cluster.recorded("migrated")) == cluster["p"].migrations == 1
    assert (len(cluster.active()), len(cluster.where("p"))) == (1, 2)


def test_a_drained_host_keeps_no_standby() -> None:
    """The standby is placed on another host."""
    cluster = with_standby("b", "c")
    host = standby_of(cluster)
    cluster.set_host(host, "drain")
    cluster.wait(8.0)
    assert standby_of(cluster) != host


def test_cancel_ends_primary_and_standby() -> None:
    """No instance is left in the state of the master."""
    cluster = with_standby()
    cluster.cancel("p")
    cluster.wait(1.0)
    assert (cluster.phase("p"), cluster.where("p")) == ("cancelled", [])
    assert not cluster.state.instances


def test_a_restarted_master_keeps_the_standby() -> None:
    """The same standby takes over when its primary is lost."""
    cluster = with_standby()
    cluster.restart_master()
    cluster.wait(11.0)
    assert (cluster.where("p"), cluster.active(), cluster["p"].owner) == (["a", "b"], ["a"], 1)
    lose(cluster, "a")
    assert (cluster.phase("p"), cluster["p"].owner) == ("running", 2)


@pytest.mark.parametrize("first", ["primary", "standby"])
@pytest.mark.parametrize("why_not", ["", "no state", "restarted"])
def test_a_standby_takes_over_from_a_primary_that_ended_without_a_master(
    why_not: str, first: str
) -> None:
    """Whichever host reports first to the next master; one without the newest state fails."""
    cluster = with_standby(
        quirk=why_not if why_not == "no state" else "", restart=RestartPolicy("on-failure")
    )
    machine = cluster.machines["a"]
    cluster.kill_master()
    if why_not == "restarted":
        machine.finish("p", cluster.now, code=3)
    machine.programs[machine.find("p")].restart = RestartPolicy("never")
    machine.finish("p", cluster.now, code=3)
    machine.connected = first == "primary"
    for one in cluster.machines.values():
        if one.connected:
            cluster.register(one)
            cluster.wait(1.0)
    cluster.rejoin("a", seconds=30.0)
    found = cluster.phase("p"), cluster.active(), cluster["p"].exit_code
    assert found == (("failed", [], 3) if why_not else ("running", ["b"], None))


def test_a_primary_that_was_stopped_for_its_standby_has_not_failed_for_the_next_master() -> None:
    """The standby cannot take over; so the process, which its policy restarts, is queued again."""
    cluster = with_standby(restart=RestartPolicy("on-failure"))
    machine = cluster.machines["a"]
    status = machine.slave.held[machine.find("p")].status
    del machine.programs[status.instance]
    for state in (InstanceState.BACKOFF, InstanceState.EXITED):
        one = machine.ends[status.instance] = replace(status, state=state, pid=0, exit_code=3)
        machine._supervisor_says(one, cluster.now)
        if state is InstanceState.BACKOFF:
            cluster.tell(machine.status_batches.popleft())  # the order to stop follows
    cluster.kill_master()
    cluster.machines["b"].quirks["p"].add("deaf")
    for other in cluster.machines.values():
        cluster.register(other)
    cluster.wait(30.0)
    assert cluster.phase("p") == "running"


def test_a_primary_is_not_given_up_for_a_standby_that_is_lost_too() -> None:
    """Both run on behind the same cut; the primary is neither killed nor replaced."""
    cluster = with_standby("b", "c")
    hosts = ["a", standby_of(cluster)]
    cluster.cut(*hosts, seconds=60.0)
    assert (cluster.phase("p"), cluster["p"].owner) == ("unreachable", 1)
    for host in hosts:
        cluster.rejoin(host, seconds=10.0)
    assert (cluster.phase("p"), cluster.active(), cluster["p"].owner) == ("running", ["a"], 1)


def test_a_primary_in_back_off_is_not_stopped_for_a_standby_on_a_silent_host() -> None:
    """The supervisor restarts the primary, because the standby may have ended."""
    cluster = with_standby(restart=RestartPolicy("on-failure"))
    cluster.cut("b", seconds=3.0)
    machine = cluster.machines["a"]
    status = machine.slave.held[machine.find("p")].status
    machine._supervisor_says(replace(status, state=InstanceState.BACKOFF, pid=0), cluster.now)
    cluster.wait(1.0)
    assert (cluster.phase("p"), cluster.where("p")) == ("backoff", ["a", "b"])


def test_a_restart_by_request_causes_no_take_over() -> None:
    """The primary restarts on its host without a failover."""
    cluster = with_standby()
    cluster.restart("p")
    cluster.wait(1.0)
    assert not cluster.recorded("failed_over")
    assert cluster.active() == ["a"]


def test_the_standby_of_a_restarted_primary_is_replaced() -> None:
    """The new run may miss the SHADOW: newer messages about other handoffs have replaced it."""
    cluster = with_standby()
    cluster.air.latched.clear()
    cluster.restart("p")
    cluster.wait(8.0)
    assert cluster.recorded("standby_lost") == [
        "p has no standby: p#1 was restarted; the master starts another one in 2 s"
    ]
    assert len(cluster.recorded("standby_ready")) == 2
    assert (cluster.where("p"), cluster.active(), cluster["p"].owner) == (["a", "b"], ["a"], 1)


def test_a_standby_with_the_state_of_a_former_run_does_not_take_over() -> None:
    """The new run ends before the master has replaced the standby."""
    cluster = with_standby()
    cluster.restart("p")
    cluster.leave("a")
    cluster.wait(5.0)
    assert not cluster.recorded("failed_over")
    assert cluster.active() == ["b"]


def test_a_failed_move_keeps_the_standby() -> None:
    """The same standby stays ready."""
    cluster = moving_to_an_unready_host()
    cluster.wait(15.0)
    assert len(cluster.recorded("stayed")) == 1
    assert len(cluster.recorded("standby_begun")) == 1
    assert len(cluster.where("p")) == 2
    lose(cluster, "a")
    assert len(cluster.recorded("failed_over")) == 1


def test_the_standby_takes_over_from_a_source_that_is_lost_in_its_move() -> None:
    """The destination had no state yet: the move is undone, and the standby takes over."""
    cluster = moving_to_an_unready_host()
    standby = cluster.state.standbys["p"].destination_host.name
    cluster.cut("a", seconds=25.0)
    assert cluster.phase("p") == "running"
    assert cluster.state.instances[cluster["p"].owner].host.name == standby


def test_a_primary_that_rejoins_during_the_take_over_is_fenced() -> None:
    """The fence comes before the commit, because the successor may be active at any moment."""
    cluster = with_standby("b", "c")
    cluster.cut("a", seconds=9.5)
    cluster.cut("b", seconds=0.8)  # it does not receive the order to take over
    assert (cluster.phase("p"), cluster["p"].owner) == ("migrating", 1)
    cluster.reconnect("a", seconds=0.3)
    assert [order.instance.number for order in cluster.orders(FenceInstance)] == [1]


def test_an_ended_process_is_not_pruned_before_its_standby_is_given_up() -> None:
    """Otherwise the review of standbys would look for a process that is gone."""
    cluster = with_standby()
    cluster.finish("p", "b")
    cluster.cancel("p")
    assert cluster.phase("p") == "cancelled"
    refused = cluster.ask(happened.PruneRequested, ("p",))
    assert refused.message == "the standby of p is being ended. Nothing was removed"
    cluster.wait(1.0)
    assert cluster.ask(happened.PruneRequested, ("p",)).accepted
    cluster.wait(1.0)


def test_an_instance_that_is_being_stopped_is_not_readopted_after_another_loss() -> None:
    """The host returned while the standby, which was not ready, had to end, and is lost again."""
    cluster = with_standby(quirk="unfit", host_loss=HostLossPolicy("elsewhere"))
    for machine in cluster.machines.values():
        machine.stubborn.add("p")
    lose(cluster, "a")
    assert cluster.phase("p") == "stopping"
    cluster.restart_slave("a")
    cluster.let_go("p", "b")
    cluster.set_host("b", "cordon")
    lose(cluster, "a")
    cluster.reconnect("a", seconds=2.0)
    check(cluster.state)
    cluster.let_go("p", "a")
    cluster.wait(3.0)
    assert (cluster.phase("p"), cluster.where("p")) == ("running", ["a"])
