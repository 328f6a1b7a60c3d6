"""Modes: one set of applications is in force, and a switch to another is one request."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from rosrm.core.master import events as happened
from rosrm.core.master.commands import Reply
from rosrm.core.master.modes.settings import apply_settings
from rosrm.core.master.modes.switching import mode_rows
from rosrm.extensions.placement import PolicySettings, ScoringLink
from rosrm.model.applications import RolloutPolicy, Target
from rosrm.model.ledger import BOUNDS, Amount, Store
from rosrm.model.modes import Mode, Trigger
from rosrm.model.values import (
    HostLossPolicy,
    InstanceId,
    InstanceState,
    InstanceStatus,
    ProcessSpec,
    Readiness,
    StartOrder,
)
from tests.unit.core.cluster import Cluster, Eq1, Machine, job, movable, node, process
from tests.unit.core.test_applications import actions, new, row


def target(name: str, *specs: ProcessSpec, **rollout: Any) -> Target:
    """Return the desired state of an application."""
    policy = RolloutPolicy(**{"healthy_for": 1.0, **rollout})
    return Target(name, tuple(replace(one, application=name) for one in specs), rollout=policy)


NAV = target("nav", process("planner"), process("driver"))
MAP = target("map", process("mapper"))
DOCK = target("dock", process("charger"))
EXPLORING = Mode("exploring", (NAV, MAP))
DOCKED = Mode("docked", (NAV, DOCK))


def load(cluster: Cluster, *modes: Mode) -> Reply:
    return cluster.ask(happened.ModesLoaded, modes)


def switch(cluster: Cluster, mode: str, seconds: float = 3.0, *, plan: bool = False) -> Reply:
    """Request a mode, and let time pass."""
    reply = cluster.ask(happened.ModeRequested, mode, plan)
    cluster.wait(seconds)
    return reply


def states(cluster: Cluster) -> dict[str, str]:
    return {row.name: row.state for row in mode_rows(cluster.state)}


def running(cluster: Cluster) -> set[str]:
    """Return the names of all processes that really run."""
    return {name for name in cluster.state.processes if cluster.where(name)}


def in_mode(mode: str, *modes: Mode, cluster: Cluster | None = None) -> Cluster:
    """Return a cluster with the modes, of which one is in force."""
    cluster = cluster or Cluster("a", "b")
    assert load(cluster, *modes).accepted
    assert switch(cluster, mode).accepted
    assert states(cluster)[mode] == "in force"
    return cluster


# --- switches ---------------------------------------------------------------------------------


def test_a_switch_does_not_touch_what_both_modes_share() -> None:
    """The rest of the new mode starts, and that of the old one stops."""
    cluster = in_mode("exploring", EXPLORING, DOCKED)
    kept = [cluster[name].owner for name in ("planner", "driver")]
    reply = switch(cluster, "docked")
    assert actions(reply) == {"charger": "start", "mapper": "stop"}
    assert running(cluster) == {"planner", "driver", "charger"}
    assert [cluster[name].owner for name in ("planner", "driver")] == kept
    assert states(cluster) == {"exploring": "", "docked": "in force"}
    assert cluster.recorded("mode_reached")[-1] == "the mode docked is in force"


def test_a_switch_stops_a_process_of_another_application_after_its_dependants() -> None:
    """The order of the applications does not matter."""
    sensors = target("sensors", process("camera"))
    nav = target("nav", process("planner", start_order=StartOrder({"camera": "ready"})))
    cluster = Cluster(Machine("a", stubborn={"planner"}))
    in_mode(
        "exploring", Mode("exploring", (sensors, nav)), Mode("docked", (DOCK,)), cluster=cluster
    )
    switch(cluster, "docked", 2.0)
    assert cluster["camera"].reason == "being cancelled; waits until planner has ended"
    cluster.let_go("planner")
    cluster.wait(2.0)
    assert (cluster.phase("camera"), states(cluster)["docked"]) == ("cancelled", "in force")


def test_a_mode_changes_the_parameters_of_an_application() -> None:
    """The changed process is replaced."""
    slow = replace(DOCKED, targets=(target("nav", new(movable("planner")), process("driver")),))
    cluster = in_mode("exploring", EXPLORING, slow)
    assert actions(switch(cluster, "docked", 9.0)) == {"planner": "replace", "mapper": "stop"}
    assert states(cluster)["docked"] == "in force"
    assert cluster.state.applications["nav"].wanted == 2


def test_a_plan_of_a_switch_changes_nothing() -> None:
    """The plan lists the actions of the switch."""
    cluster = in_mode("exploring", EXPLORING, DOCKED)
    planned = switch(cluster, "docked", plan=True)
    assert actions(planned) == {"charger": "start", "mapper": "stop"}
    assert states(cluster) == {"exploring": "in force", "docked": ""}
    assert actions(switch(cluster, "exploring", plan=True)) == {}


@pytest.mark.parametrize("killed_after", range(0, 24, 2))
def test_a_killed_master_goes_on_with_a_switch(killed_after: int) -> None:
    """At each moment; every process runs once."""
    changed = target("nav", new(movable("planner")), process("driver"))
    docked = replace(DOCKED, targets=(changed, DOCK))
    exploring = replace(EXPLORING, targets=(target("nav", movable("planner")), MAP))
    cluster = in_mode("exploring", exploring, docked)
    switch(cluster, "docked", killed_after * 0.1)
    cluster.kill_master()
    cluster.wait(0.5)  # a moment without any host
    for machine in cluster.machines.values():
        cluster.register(machine)
    cluster.wait(15.0)
    assert states(cluster) == {"exploring": "", "docked": "in force"}
    assert running(cluster) == {"planner", "driver", "charger"}


# --- modes that cannot be reached -------------------------------------------------------------


@pytest.mark.parametrize(
    ("charger", "why"),
    [
        (process("charger", 20_000), "charger would wait: "),
        (process("charger", required_labels={"dock": "yes"}), "charger would wait: "),
    ],
)
def test_a_mode_without_a_host_for_a_process_is_refused(charger: ProcessSpec, why: str) -> None:
    """The old mode stays in force; the plan says the same."""
    cluster = in_mode("exploring", EXPLORING, Mode("docked", (NAV, target("dock", charger))))
    before = running(cluster)
    reply = switch(cluster, "docked")
    assert not reply.accepted
    assert reply.message.startswith(f"the mode docked cannot be reached: {why}")
    assert reply.message.endswith("exploring stays in force")
    assert (running(cluster), states(cluster)["exploring"]) == (before, "in force")
    assert why in switch(cluster, "docked", plan=True).message


def test_a_mode_whose_process_fails_is_left_again() -> None:
    """The old mode returns, with its own processes; the record and the list say why."""
    cluster = in_mode("exploring", EXPLORING, DOCKED)
    kept = cluster["planner"].owner
    for machine in cluster.machines.values():
        machine.refuses["charger"] = "no such program"
    switch(cluster, "docked", 9.0)
    assert running(cluster) == {"planner", "driver", "mapper"}
    assert cluster["planner"].owner == kept
    assert states(cluster)["exploring"] == "in force"
    (failed,) = cluster.recorded("mode_failed")
    assert failed.startswith("the mode docked is not reached, and exploring returns: charger ")
    (row,) = [one for one in mode_rows(cluster.state) if one.name == "docked"]
    assert row.reason.startswith("charger ")


def test_a_mode_whose_new_application_crashes_is_left_again() -> None:
    """The first version of an application has none to return to, but the mode has."""
    cluster = in_mode("exploring", EXPLORING, DOCKED)
    switch(cluster, "docked", 0.0)
    crashed = InstanceId("charger", cluster["charger"].owner)
    (host,) = cluster.where("charger")
    cluster.report(host, InstanceStatus(crashed, InstanceState.BACKOFF, message="exit code 1"))
    cluster.wait(6.0)
    (failed,) = cluster.recorded("mode_failed")
    why = "charger does not run well: exit code 1"
    assert failed == f"the mode docked is not reached, and exploring returns: {why}"
    assert states(cluster) == {"exploring": "in force", "docked": ""}
    assert running(cluster) == {"planner", "driver", "mapper"}


def test_a_mode_whose_process_finds_no_room_for_long_is_left_again() -> None:
    """The plan found a host, but the room is taken before the process starts."""
    late = process("charger", 8_000, start_order=StartOrder({"calibrate": "finished"}))
    cluster = in_mode(
        "exploring", EXPLORING, Mode("docked", (NAV, target("dock", job("calibrate"), late))),
        cluster=Cluster("a", progress_deadline=20.0),
    )  # fmt: skip
    assert switch(cluster, "docked").accepted
    cluster.with_processes(process("x", 10_000))
    cluster.finish("calibrate")
    cluster.wait(30.0)
    assert states(cluster) == {"exploring": "in force", "docked": ""}
    (failed,) = cluster.recorded("mode_failed")
    assert "docked is not reached, and exploring returns: charger finds no host: " in failed


def with_a_waiting_process() -> Cluster:
    """Return a cluster in a mode of which a process has waited long for the room of another one."""
    waiting = target("nav", process("planner", 8_000, host_loss=HostLossPolicy("elsewhere")))
    large = target("map", process("mapper", 8_000))
    cluster = in_mode(
        "exploring", Mode("exploring", (waiting, large)), Mode("docked", (waiting,)),
        cluster=Cluster("a", "b", progress_deadline=20.0),
    )  # fmt: skip
    cluster.cut(*cluster.where("planner"))
    cluster.wait(60.0)
    return cluster


def test_a_wait_before_the_switch_is_no_fault_of_the_mode() -> None:
    """The new mode stops a process, and another process that has waited gets its room."""
    cluster = with_a_waiting_process()
    assert cluster.phase("planner") == "queued"
    (host,) = cluster.where("mapper")
    cluster.machines[host].stubborn.add("mapper")
    assert switch(cluster, "docked").accepted
    cluster.let_go("mapper", host)
    cluster.wait(3.0)
    assert states(cluster) == {"exploring": "", "docked": "in force"}


def test_a_clock_that_is_set_ends_no_switch() -> None:
    """A restarted master counts the wait of a process by its own time, not by unix time."""
    cluster = with_a_waiting_process()
    (host,) = cluster.where("mapper")
    cluster.machines[host].stubborn.add("mapper")
    assert switch(cluster, "docked").accepted
    cluster.clock_set_by = 2e9
    cluster.restart_master()
    cluster.wait(3.0)
    assert not cluster.recorded("mode_failed")


def test_a_new_version_that_fails_ends_the_switch() -> None:
    """The application returns to its former version, and the cluster to its former mode."""
    worse = target("nav", new(movable("planner")), process("driver"), healthy_for=3.0)
    cluster = in_mode("exploring", replace(EXPLORING, targets=(
        target("nav", movable("planner"), process("driver")), MAP)),
        replace(DOCKED, targets=(worse, DOCK)))  # fmt: skip
    switch(cluster, "docked", 2.5)
    cluster.finish("planner", on=cluster.where("planner")[0], code=1)
    cluster.wait(15.0)
    assert states(cluster) == {"exploring": "in force", "docked": ""}
    assert running(cluster) == {"planner", "driver", "mapper"}


@pytest.mark.parametrize("restarted", [False, True])
def test_a_switch_that_fails_returns_to_the_mode_that_was_in_force(restarted: bool) -> None:
    """The return does not lead to a mode that was only being reached, also after a restart."""
    slow = Mode("slow", (target("slow", node("late", readiness=Readiness(timeout=600.0))),))
    broken = Mode("broken", (target("broken", node("faulty")),))
    cluster = in_mode("docked", DOCKED, slow, broken)
    switch(cluster, "slow")
    assert states(cluster)["slow"] == "switching"
    if restarted:
        cluster.restart_master()
    switch(cluster, "broken", 0.1)
    cluster.finish("faulty", cluster.where("faulty")[0], code=1)
    cluster.wait(3.0)
    assert states(cluster)["docked"] == "in force"
    assert cluster.recorded("mode_failed") == [
        "the mode broken is not reached, and docked returns: faulty has failed: exit code 1"
    ]


def test_a_mode_that_was_never_in_force_is_not_returned_to() -> None:
    """The first mode failed, and the second one fails, too, so there is no mode to return to."""
    modes = [Mode(name, (target(name, process(f"p_{name}")),)) for name in ("one", "two")]
    cluster = Cluster("a")
    load(cluster, *modes)
    for name in ("one", "two"):
        switch(cluster, name, 0.0)
        cluster.finish(f"p_{name}", code=1)
        cluster.wait(3.0)
    assert len(cluster.recorded("mode_failed")) == 2
    assert cluster.state.modes.wanted == "two"


def test_an_unknown_mode_is_refused_with_the_nearest_name() -> None:
    """Nothing is changed."""
    cluster = in_mode("exploring", EXPLORING, DOCKED)
    reply = switch(cluster, "dokced")
    assert (reply.accepted, reply.code) == (False, "unknown")
    assert "'docked'" in reply.message


# --- conditions -------------------------------------------------------------------------------


def test_the_loss_of_a_host_puts_its_mode_into_force_once() -> None:
    """An operator may leave it again while the host is away, also over a restart of the master."""
    degraded = replace(DOCKED, when=Trigger(host_lost="b"))
    loss = HostLossPolicy("elsewhere")
    nav = target("nav", process("planner", host_loss=loss), process("driver", host_loss=loss))
    cluster = in_mode(
        "exploring", replace(EXPLORING, targets=(nav, MAP)), replace(degraded, targets=(nav, DOCK))
    )
    cluster.cut("b", seconds=15.0)
    assert states(cluster)["docked"] == "in force"
    assert "the cluster switches to the mode docked: b is lost" in cluster.recorded("mode_begins")
    assert switch(cluster, "exploring").accepted
    cluster.restart_master()
    cluster.wait(15.0)
    assert states(cluster)["exploring"] == "in force"
    cluster.rejoin("b")
    cluster.cut("b", seconds=15.0)
    assert states(cluster)["docked"] == "in force"


def test_a_host_that_stays_over_its_limit_puts_a_mode_into_force() -> None:
    """After the time of the condition, not before."""
    degraded = replace(DOCKED, when=Trigger(over_limit="memory", lasts=5.0))
    cluster = in_mode("exploring", EXPLORING, degraded)
    cluster.machines["b"].busy["memory"] = 0.95
    cluster.wait(3.0)
    assert states(cluster)["exploring"] == "in force"
    cluster.wait(5.0)
    assert states(cluster)["docked"] == "in force"


def test_a_host_that_stays_over_its_limit_is_no_new_condition_after_a_restart() -> None:
    """The operator has left the mode, and the master was restarted since."""
    degraded = replace(DOCKED, when=Trigger(over_limit="memory", lasts=5.0))
    cluster = in_mode("exploring", EXPLORING, degraded)
    cluster.machines["b"].busy["memory"] = 0.95
    cluster.wait(8.0)
    assert switch(cluster, "exploring").accepted
    cluster.restart_master()
    cluster.wait(15.0)
    assert states(cluster)["exploring"] == "in force"
    cluster.machines["b"].busy["memory"] = 0.1
    cluster.wait(3.0)
    cluster.machines["b"].busy["memory"] = 0.95
    cluster.wait(8.0)
    assert states(cluster)["docked"] == "in force"


def test_moves_off_a_host_over_its_limit_do_not_begin_the_time_of_a_condition_again() -> None:
    """A host that stays over its limit although processes are moved away needs the mode most."""
    parts = [movable(f"p{number}") for number in range(3)]
    degraded = replace(DOCKED, when=Trigger(over_limit="memory", lasts=5.0))
    cluster = Cluster("a", "b")
    cluster.set_host("a", "cordon")
    in_mode("exploring", Mode("exploring", (target("nav", *parts),)), degraded, cluster=cluster)
    cluster.set_host("a", "uncordon")
    cluster.machines["b"].busy["memory"] = 0.95
    for part in parts:
        cluster.wait(2.0)
        cluster.migrate(part.name, "a")
    cluster.wait(2.0)
    assert [cluster[name].migrations for name in ("p0", "p1")] == [1, 1]
    assert states(cluster)["docked"] == "in force"


def test_a_condition_whose_mode_cannot_be_reached_changes_nothing() -> None:
    """The record says so, once."""
    never = target("dock", process("charger", required_labels={"dock": "yes"}))
    cluster = in_mode("exploring", EXPLORING, Mode("docked", (never,), when=Trigger("b")))
    cluster.cut("b", seconds=15.0)
    assert states(cluster) == {"exploring": "in force", "docked": ""}
    (failed,) = cluster.recorded("mode_failed")
    assert failed.startswith("b is lost, but the mode docked cannot be reached: charger would wait")


def unreached() -> Cluster:
    """Return a cluster with a condition whose mode finds no host, because both are away."""
    degraded = replace(DOCKED, when=Trigger(host_lost="b"))
    cluster = in_mode("exploring", EXPLORING, degraded)
    cluster.cut("a", "b", seconds=14.0)
    assert states(cluster) == {"exploring": "in force", "docked": ""}
    assert len(cluster.recorded("mode_failed")) == 1
    return cluster


@pytest.mark.parametrize("restarted", [False, True])
def test_a_mode_is_reached_later_if_its_condition_still_holds(restarted: bool) -> None:
    """All hosts were lost when the condition began to hold; one event records the wait."""
    cluster = unreached()
    if restarted:
        cluster.restart_master()
    cluster.reconnect("a", seconds=60.0)
    if restarted:
        cluster.rejoin("a", 60.0)
    assert states(cluster)["docked"] != ""
    assert len(cluster.recorded("mode_failed")) <= 2


def test_a_switch_ends_the_tries_to_reach_another_mode() -> None:
    """The decision of an operator counts although the condition of the other mode holds."""
    cluster = unreached()
    cluster.reconnect("a", seconds=0.1)
    assert cluster.state.modes.retries
    assert switch(cluster, "exploring").accepted
    cluster.wait(60.0)
    assert states(cluster)["docked"] == ""


# --- limits and weights -----------------------------------------------------------------------


def test_the_limits_of_a_mode_apply_while_it_is_in_force() -> None:
    """No host may exceed them, and none may exceed its own; later readings change nothing."""
    cluster = Cluster(Machine("a", limits={"memory": 0.7}), Machine("b", limits={"memory": 0.9}))
    tight = replace(DOCKED, limits={"memory": 0.8})

    def limits() -> list[float]:
        table = cluster.state.hosts
        return [float(one) for one in table.limit[table.resources.index("memory")]]

    in_mode("exploring", EXPLORING, tight, cluster=cluster)
    assert limits() == [0.7, 0.9]
    switch(cluster, "docked")
    assert limits() == [0.7, 0.8]
    cluster.restart_master()
    assert limits() == [0.7, 0.8]
    switch(cluster, "exploring")
    assert limits() == [0.7, 0.9]


def test_the_weights_of_a_mode_apply_while_it_is_in_force() -> None:
    """They replace those of the policies that have weights."""
    cluster = Cluster("a", Machine("b", busy={"memory": 0.1, "cpu": 0.6}))
    made: list[Any] = []

    def chain_of(settings: Any) -> tuple[ScoringLink, ...]:
        made.append({one.name: one.options for one in settings})
        return tuple(ScoringLink("eq1", Eq1(**one.options["weights"])) for one in settings)

    cluster.state.chain_of = chain_of
    cluster.state.scoring = (PolicySettings("eq1", 1.0, {"weights": {"memory": 1.0}}),)
    in_mode("docked", replace(DOCKED, weights={"memory": 0.0, "cpu": 1.0}), EXPLORING,
            cluster=cluster)  # fmt: skip
    assert made[-1] == {"eq1": {"weights": {"memory": 0.0, "cpu": 1.0}}}
    switch(cluster, "exploring")
    assert made[-1] == {"eq1": {"weights": {"memory": 1.0}}}


def test_new_weights_apply_to_a_process_that_waits_already() -> None:
    """No cached demand or ranking keeps the former policies."""
    cluster = Cluster(Machine("a", busy={"memory": 0.6, "cpu": 0.1}))
    cluster.state.chain_of = lambda settings: tuple(
        ScoringLink("eq1", Eq1(**one.options["weights"])) for one in settings
    )
    cluster.set_host("a", "cordon")
    cluster.submit(process("p"))
    by_cpu = {"weights": {"memory": 0.0, "cpu": 1.0}}
    cluster.state.scoring = (PolicySettings("eq1", 1.0, by_cpu),)
    apply_settings(cluster.state)
    cluster.set_host("a", "uncordon")
    (verdict,) = cluster.explain("p")["decision"]["hosts"]
    assert verdict["score"] == pytest.approx(0.1)


# --- loading ----------------------------------------------------------------------------------


def test_a_mode_says_which_of_its_applications_have_changed_since() -> None:
    """The mode stays in force, also in the next master; the same request restores it."""
    cluster = in_mode("exploring", EXPLORING, DOCKED)
    why = "map was cancelled since; `rosrm mode exploring` applies the mode again"
    assert cluster.apply("map").accepted
    cluster.wait(2.0)
    for _ in range(2):
        (listed, _docked) = mode_rows(cluster.state)
        assert (listed.state, listed.reason) == ("in force", why)
        application = row(cluster, "map")
        assert (application.state, application.reason) == (
            "cancelled", "the mode exploring has it: `rosrm mode exploring` applies it again"
        )  # fmt: skip
        cluster.restart_master()
        cluster.wait(1.0)
    cluster.apply("nav", new(process("planner")), process("driver"))
    cluster.wait(5.0)
    (listed, _docked) = mode_rows(cluster.state)
    assert listed.reason.startswith("nav was changed since and map was cancelled since; ")
    assert switch(cluster, "exploring", 6.0).accepted
    assert running(cluster) == {"planner", "driver", "mapper"}
    assert mode_rows(cluster.state)[0].reason == row(cluster, "map").reason == ""


def test_the_mode_in_force_cannot_be_removed() -> None:
    """The other modes can be replaced."""
    cluster = in_mode("exploring", EXPLORING, DOCKED)
    reply = load(cluster, DOCKED)
    assert not reply.accepted
    assert "the mode exploring is in force, and the file does not have it" in reply.message
    assert load(cluster, EXPLORING).message == "1 mode loaded: exploring"
    assert list(cluster.intents["mode"]) == ["exploring"]


def test_modes_that_are_loaded_in_a_switch_do_not_end_it() -> None:
    """The applications stay as they are; the next request for the mode applies the new one."""
    waits = process("charger", start_order=StartOrder({"check": "finished"}))
    docked = Mode("docked", (NAV, target("dock", waits, job("check"))))
    cluster = in_mode("exploring", EXPLORING, docked)
    switch(cluster, "docked", 1.0)
    more = target("lights", process("lamp"))
    assert load(cluster, EXPLORING, replace(docked, targets=(*docked.targets, more))).accepted
    cluster.wait(1.0)
    assert states(cluster)["docked"] == "switching"
    cluster.finish("check", on=cluster.where("check")[0])
    cluster.wait(3.0)
    assert running(cluster) == {"planner", "driver", "charger"}
    assert states(cluster)["docked"] == "in force"
    switch(cluster, "docked")
    assert "lamp" in running(cluster)


def test_modes_survive_a_restart_of_the_master() -> None:
    """In the order of their file."""
    cluster = in_mode("exploring", EXPLORING, replace(DOCKED, when=Trigger(over_limit="cpu")))
    before = mode_rows(cluster.state)
    cluster.restart_master()
    assert mode_rows(cluster.state) == before
    assert cluster.state.modes.known["docked"].targets == DOCKED.targets


def test_a_switch_that_makes_room_for_its_specs_may_remove_what_it_cancels(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """An owner at the bound of what may be stored loses ended applications, the oldest first."""
    bound = (Amount(50, 100 * 1024), Amount(500, 100 * 1024))
    monkeypatch.setitem(BOUNDS, Store.SPECS, bound)  # type: ignore[misc]
    cluster = Cluster("a")

    def large(name: str, size: int) -> ProcessSpec:
        return process(name, environment={"X": "x" * size * 1024})

    docked = Mode("docked", (target("dock", large("charger", 36)),))
    assert load(cluster, Mode("exploring", (target("map", large("mapper", 10)),)), docked).accepted
    switch(cluster, "exploring")
    cluster.apply("old", large("o", 20))
    cluster.wait(1.0)
    cluster.apply("old")
    cluster.wait(1.0)
    cluster.finish("mapper", code=1)
    cluster.wait(1.0)
    assert switch(cluster, "docked").accepted
    assert "map" not in cluster.state.applications
