"""Loss and rejoin of hosts: the effect on their processes."""

from __future__ import annotations

from typing import Any

import pytest

from rosrm.core.master import events as happened
from rosrm.core.master import listing
from rosrm.core.master.settings import CoreSettings
from rosrm.core.slave import events
from rosrm.model.orders import FenceInstance, SetRestartPolicy
from rosrm.model.values import (
    HostLossPolicy,
    InstanceState,
    IsolationPolicy,
    MigrationPolicy,
    ProcessSpec,
    RestartPolicy,
    StandbyPolicy,
    StopPolicy,
)
from tests.unit.core.cluster import Cluster, job, movable, process
from tests.unit.core.machine import Machine

ELSEWHERE = HostLossPolicy("elsewhere")


def lose(cluster: Cluster, *names: str, seconds: float = 12.0) -> None:
    """Cut hosts off for longer than their lease."""
    for name in names:
        cluster.machines[name].connected = False
    cluster.wait(seconds)


def back(cluster: Cluster, *names: str, seconds: float = 1.0) -> None:
    for name in names:
        cluster.machines[name].connected = True
    cluster.wait(seconds)


def on_a(spec: ProcessSpec, *others: str, **settings: Any) -> Cluster:
    """Return a cluster in which a process runs on host a."""
    cluster = Cluster("a", **settings)
    cluster.submit(spec)
    for name in others:
        cluster.add(name)
    cluster.wait(11.0)  # the master has had contact with some host for a whole lease
    assert cluster.where(spec.name) == ["a"]
    return cluster


# --- host-loss policies -----------------------------------------------------------------------


def test_by_default_a_process_waits_for_its_host() -> None:
    """The process may still run there, so it waits for any time (here ten leases)."""
    cluster = on_a(process("p"), "b")
    lose(cluster, "a", seconds=100.0)
    assert (cluster.phase("p"), cluster["p"].reason) == ("unreachable", "a is lost")
    back(cluster, "a")
    assert (cluster.phase("p"), cluster.where("p")) == ("running", ["a"])


def test_elsewhere_starts_it_on_another_host_as_soon_as_its_host_is_lost() -> None:
    """The successor starts as soon as the lease has expired, not before."""
    cluster = on_a(process("p", host_loss=ELSEWHERE), "b")
    lose(cluster, "a", seconds=9.5)
    assert cluster.where("p") == ["a"]
    cluster.wait(1.0)
    assert cluster.where("p") == ["a", "b"]
    assert (cluster.phase("p"), cluster["p"].owner) == ("running", 2)
    assert cluster.recorded("given_up") == ["p#1 is given up: a is lost"]


def test_elsewhere_waits_for_its_delay() -> None:
    """The reason names the delay."""
    cluster = on_a(process("p", host_loss=HostLossPolicy("elsewhere", 20.0)), "b")
    lose(cluster, "a", seconds=25.0)
    assert cluster["p"].reason == "a is lost; the process is started on another host in 20 s"
    assert cluster.where("p") == ["a"]
    cluster.wait(6.0)
    assert cluster.where("p") == ["a", "b"]


def test_stop_lets_it_fail() -> None:
    """The process has no successor, and is stopped when its host rejoins."""
    cluster = on_a(process("p", host_loss=HostLossPolicy("stop")), "b")
    lose(cluster, "a")
    assert (cluster.phase("p"), cluster["p"].reason) == ("failed", "a is lost")
    assert cluster.where("p") == ["a"]
    back(cluster, "a")
    assert cluster.where("p") == []


# --- rejoin -----------------------------------------------------------------------------------


def test_the_old_instance_is_fenced_when_its_host_is_heard() -> None:
    """The new instance owns the name, so the old one ends at once, without its stop time."""
    cluster = on_a(process("p", host_loss=ELSEWHERE), "b")
    cluster.machines["a"].stubborn.add("p")
    lose(cluster, "a")
    back(cluster, "a", seconds=0.2)
    assert cluster.where("p") == ["b"]
    assert [order.instance.number for order in cluster.orders(FenceInstance)] == [1]
    assert cluster.recorded("fenced")[0].startswith(
        "p#1 is not assigned to a: the master has it killed"
    )


def test_the_old_instance_is_fenced_by_a_master_that_was_restarted() -> None:
    """The new master fences an instance that its journal does not contain."""
    cluster = on_a(process("p", host_loss=ELSEWHERE), "b")
    lose(cluster, "a")
    cluster.restart_master()
    assert cluster.phase("p") == "running"
    cluster.rejoin("a")
    assert cluster.where("p") == ["b"]


@pytest.mark.parametrize("restarted", [False, True], ids=["same master", "restarted master"])
def test_what_nothing_has_followed_goes_on(restarted: bool) -> None:
    """With no room elsewhere, the process leaves the queue and keeps running untouched."""
    cluster = on_a(process("p", host_loss=ELSEWHERE, required_labels={}), "b")
    cluster.set_host("b", "cordon")
    lose(cluster, "a")
    assert (cluster.phase("p"), cluster.queue()) == ("queued", ["p"])
    if restarted:
        cluster.restart_master()
        cluster.machines["a"].connected = True
        cluster.register(cluster.machines["a"])
    back(cluster, "a")
    assert (cluster.phase("p"), cluster["p"].owner, cluster.queue()) == ("running", 1, [])
    assert cluster.where("p") == ["a"]
    assert not cluster.orders(FenceInstance)
    cluster.set_host("b", "uncordon")
    cluster.cancel("p")
    assert (cluster.phase("p"), cluster.where("p")) == ("cancelled", [])


def test_a_job_that_completed_out_of_sight_is_not_done_again() -> None:
    """The job had no successor yet."""
    cluster = on_a(job("p", host_loss=ELSEWHERE), "b")
    cluster.set_host("b", "cordon")
    lose(cluster, "a")
    cluster.machines["a"].finish("p", cluster.now)
    back(cluster, "a")
    assert (cluster.phase("p"), cluster.queue()) == ("finished", [])


def test_what_failed_out_of_sight_has_failed() -> None:
    """The host has applied the process's restart policy, so the failure is final."""
    cluster = on_a(process("p", host_loss=ELSEWHERE), "b")
    cluster.set_host("b", "cordon")
    lose(cluster, "a")
    cluster.machines["a"].finish("p", cluster.now, code=3)
    back(cluster, "a")
    assert (cluster.phase("p"), cluster["p"].exit_code) == ("failed", 3)


def test_what_is_not_there_any_more_goes_elsewhere() -> None:
    """A host that lost its power rejoins without the process."""
    cluster = on_a(process("p", host_loss=ELSEWHERE), "b")
    cluster.set_host("b", "cordon")
    lose(cluster, "a")
    cluster.machines["a"].programs.clear()
    cluster.machines["a"].restart_slave(cluster.now)
    cluster.rejoin("a")
    assert (cluster.phase("p"), cluster["p"].owner, cluster.where("p")) == ("running", 2, ["a"])


# --- lost host or isolated master -------------------------------------------------------------


def test_a_master_that_hears_nobody_gives_nothing_up() -> None:
    """A host that rejoins within a lease of the first host keeps its processes."""
    cluster = on_a(process("p", host_loss=ELSEWHERE), "b")
    lose(cluster, "a", "b", seconds=60.0)
    assert (cluster.phase("p"), cluster.recorded("given_up")) == ("unreachable", [])
    back(cluster, "b", seconds=8.0)
    back(cluster, "a")
    assert (cluster.phase("p"), cluster.where("p")) == ("running", ["a"])
    assert not cluster.recorded("given_up")


def test_a_host_that_stays_away_when_the_others_are_back_is_given_up() -> None:
    """The host is given up one lease after the first host rejoined."""
    cluster = on_a(process("p", host_loss=ELSEWHERE), "b")
    lose(cluster, "a", "b", seconds=60.0)
    back(cluster, "b", seconds=12.0)
    assert cluster.where("p") == ["a", "b"]


def test_a_restarted_master_gives_the_hosts_their_lease_first() -> None:
    """A new master has had no contact yet, so silence counts from its start."""
    cluster = on_a(process("p", host_loss=ELSEWHERE), "b")
    cluster.machines["a"].connected = False
    cluster.restart_master()
    cluster.wait(9.0)
    assert cluster.where("p") == ["a"]
    cluster.wait(3.0)
    assert cluster.where("p") == ["a", "b"]


# --- instances that do not own the name -------------------------------------------------------


BEING_CANCELLED = "being cancelled; it may still run on a, which is lost, and ends when a returns"


@pytest.mark.parametrize("then", ["wait", "stop"])
def test_a_process_on_a_lost_host_is_being_cancelled_until_the_host_reports_its_end(
    then: Any,
) -> None:
    """The process may still run there, so its name stays taken until then."""
    cluster = on_a(process("p", host_loss=HostLossPolicy(then, 50.0)), "b")
    lose(cluster, "a")
    assert cluster.cancel("p").message == f"1 process being cancelled; p is {BEING_CANCELLED}"
    cluster.wait(100.0)
    assert (cluster.phase("p"), cluster["p"].reason) == ("stopping", BEING_CANCELLED)
    assert BEING_CANCELLED in cluster.submit(process("p")).message
    back(cluster, "a")
    assert (cluster.phase("p"), cluster.where("p")) == ("cancelled", [])


def test_a_process_that_is_being_cancelled_when_its_host_is_lost_says_so() -> None:
    """The reason is kept over a restart of the master."""
    cluster = on_a(process("p"), "b")
    cluster.machines["a"].stubborn.add("p")
    cluster.cancel("p")
    lose(cluster, "a")
    assert (cluster.phase("p"), cluster["p"].reason) == ("stopping", BEING_CANCELLED)
    cluster.kill_master()
    assert cluster.phase("p") == "stopping"
    assert "a, which has not come back since the master started" in cluster["p"].reason
    cluster.machines["a"].let_go("p", cluster.now)
    cluster.rejoin("a")
    assert cluster.phase("p") == "cancelled"


def test_a_fenced_process_is_cancelled_when_its_fence_has_ended_it() -> None:
    """With `elsewhere` the process ended before a successor could have started."""
    spec = process(
        "p", host_loss=HostLossPolicy("elsewhere", 20.0), isolation=IsolationPolicy("stop")
    )
    cluster = on_a(spec, "b")
    lose(cluster, "a")
    cluster.cancel("p")
    assert cluster.phase("p") == "stopping"
    cluster.wait(20.0)
    assert cluster.phase("p") == "cancelled"


def test_a_cancelled_process_that_its_host_keeps_is_not_said_to_have_ended() -> None:
    """A fence of `isolation: keep` ends nothing while the slave runs."""
    cluster = on_a(process("p", host_loss=HostLossPolicy("elsewhere", 20.0)), "b")
    lose(cluster, "a")
    cluster.cancel("p")
    cluster.wait(100.0)
    assert (cluster.phase("p"), cluster["p"].reason) == ("stopping", BEING_CANCELLED)
    back(cluster, "a")
    assert (cluster.phase("p"), cluster.where("p")) == ("cancelled", [])


def test_a_cancelled_process_waits_for_a_fence_that_is_later_than_its_delay() -> None:
    """Its own `isolation.after` counts from the last contact that its host knows of."""
    spec = process(
        "p", host_loss=HostLossPolicy("elsewhere", 20.0), isolation=IsolationPolicy("stop", 60.0)
    )
    cluster = on_a(spec, "b")
    lose(cluster, "a")
    cluster.cancel("p")
    cluster.wait(48.0)  # the lease of 10 s expired 2 s ago
    assert cluster.phase("p") == "stopping"
    cluster.wait(6.0)
    assert cluster.phase("p") == "cancelled"


def test_the_former_host_of_a_move_that_is_lost_does_not_hold_it_up() -> None:
    """The destination owns the name; the source is fenced when its host rejoins."""
    cluster = on_a(movable("p"), "b")
    cluster.machines["a"].stubborn.add("p")
    cluster.migrate("p")
    assert cluster["p"].owner == 2
    assert cluster.phase("p") == "migrating"
    lose(cluster, "a", seconds=15.0)
    assert cluster.phase("p") == "running"
    back(cluster, "a", seconds=0.5)
    assert cluster.where("p") == ["b"]


# --- fences -----------------------------------------------------------------------------------


def fence(
    host_loss: HostLossPolicy, isolation: IsolationPolicy, **settings: float
) -> tuple[float, float] | None:
    """Return the fence of the assignment of such a process: after and grace."""
    cluster = Cluster("a", **settings)
    cluster.submit(process("p", host_loss=host_loss, isolation=isolation, stop=StopPolicy(2, 1)))
    given = cluster.machines["a"].programs[cluster.machines["a"].find("p")].assignment.fence
    return None if given is None else (given.after, given.grace)


def test_by_default_nothing_is_fenced() -> None:
    """The process has no successor, so it may keep running."""
    assert fence(HostLossPolicy(), IsolationPolicy()) is None


def test_what_may_have_a_successor_is_fenced_where_its_slave_is_not_at_work() -> None:
    """A host that is only cut off keeps the process, as long as its slave runs."""
    cluster = Cluster("a")
    followed = process(
        "q", ros=True, migration=MigrationPolicy("handoff"), standby=StandbyPolicy(True)
    )
    cluster.submit(process("p", host_loss=ELSEWHERE), followed)
    machine = cluster.machines["a"]
    for name in ("p", "q"):
        given = machine.programs[machine.find(name)].assignment.fence
        assert given is not None
        assert given.alive
    cluster.submit(process("r", host_loss=ELSEWHERE, isolation=IsolationPolicy("stop")))
    assert not machine.programs[machine.find("r")].assignment.fence.alive


def test_a_fenced_process_has_ended_before_its_successor_starts() -> None:
    """The successor waits for the grace, too, counted from the last possible contact."""
    settings = CoreSettings()
    for delay in (0.0, 5.0, 60.0):
        given = fence(HostLossPolicy("elsewhere", delay), IsolationPolicy("stop"))
        assert given is not None
        assert 0.0 < sum(given) < settings.lease + delay - settings.suspect
        assert given[1] <= 3.0


def test_a_fence_of_a_short_lease_leaves_time_for_beats() -> None:
    """The time is 0.3 s with a lease of 0.8 s and suspicion after 0.3 s."""
    after, grace = fence(ELSEWHERE, IsolationPolicy("stop"), lease=0.8, suspect=0.3) or (0.0, 0.0)
    assert after == pytest.approx(0.3)
    assert grace == pytest.approx(0.1)


def test_a_time_of_ones_own_is_kept() -> None:
    """A process without a successor gets its whole grace, too."""
    assert fence(HostLossPolicy(), IsolationPolicy("stop", 7.0)) == (7.0, 3.0)
    assert fence(HostLossPolicy(), IsolationPolicy("stop")) == (CoreSettings().lease, 3.0)
    assert fence(ELSEWHERE, IsolationPolicy("stop", 100.0)) == (100.0, 0.0)


def test_beats_name_the_hosts_that_are_not_heard() -> None:
    """Beats name suspect and lost hosts, not expected ones or those that have left."""
    cluster = Cluster("a", "b", "c")
    assert cluster.state.hosts.silent_hosts() == []
    lose(cluster, "b", seconds=2.0)
    lose(cluster, "c", seconds=10.0)
    assert cluster.state.hosts.silent_hosts() == [2, 3]
    back(cluster, "b")
    assert cluster.state.hosts.silent_hosts() == [3]


@pytest.mark.parametrize(("then", "phase"), [("wait", "running"), ("stop", "failed")])
def test_what_its_host_has_fenced_starts_again(then: str, phase: str) -> None:
    """The host was cut off only briefly and never lost, so the process has no successor."""
    cluster = on_a(process("p", host_loss=HostLossPolicy(then)), "b")
    machine = cluster.machines["a"]
    machine._end(machine.find("p"), InstanceState.FENCED, cluster.now, signal=9)
    cluster.settle()
    assert cluster.phase("p") == phase


def test_what_is_taken_back_is_restarted_as_its_spec_says() -> None:
    """A move in progress at the loss had ordered the slave not to restart the process."""
    cluster = on_a(process("p", restart=RestartPolicy("on-failure"), host_loss=ELSEWHERE))
    cluster.add(Machine("b", busy={"memory": 0.9}))  # a host in contact, without room
    cluster.wait(11.0)
    a = cluster.machines["a"]
    a.tell(events.RestartPolicySet(a.find("p"), RestartPolicy("never")), cluster.now)
    lose(cluster, "a")
    assert cluster.phase("p") == "queued"
    back(cluster, "a")
    assert (cluster.phase("p"), cluster.where("p")) == ("running", ["a"])
    assert [one.restart for one in cluster.orders(SetRestartPolicy)] == [
        RestartPolicy("on-failure")
    ]


def test_what_was_cancelled_out_of_sight_is_not_taken_back() -> None:
    """The process is queued again; the old instance is ordered to end."""
    cluster = on_a(process("p", host_loss=ELSEWHERE), "b")
    cluster.set_host("b", "cordon")
    lose(cluster, "a")
    cluster.cancel("p")
    cluster.restart("p")
    back(cluster, "a")
    assert (cluster.phase("p"), cluster["p"].owner, cluster.where("p")) == ("running", 2, ["a"])


def test_a_new_process_of_the_name_waits_until_the_old_one_has_ended() -> None:
    """The lost host was pruned and the name reused; then the host returns."""
    cluster = on_a(process("p"), "b")
    cluster.machines["a"].stubborn.add("p")
    lose(cluster, "a")
    cluster.cancel("p")
    cluster.ask(happened.PruneRequested, (), ("a",))
    cluster.set_host("b", "cordon")
    assert cluster.submit(process("p")).accepted
    cluster.rejoin("a")
    assert (cluster.phase("p"), cluster.queue()) == ("stopping", [])
    assert cluster["p"].reason == "waits until p#1 on a has ended"
    cluster.machines["a"].let_go("p", cluster.now)
    cluster.wait(0.5)
    assert (cluster.phase("p"), cluster["p"].owner) == ("running", 2)


# --- what is shown ----------------------------------------------------------------------------


def test_of_a_silent_host_nothing_is_said_to_run_and_readings_are_old() -> None:
    """From the first silence on every row shows old readings; after the rejoin all is current."""
    cluster = on_a(process("p"), "b")

    def rows() -> Any:
        (process,) = listing.process_rows(cluster.state, cluster.now)
        host = listing.host_rows(cluster.state, cluster.now)[0]
        return process, host, {resource.stale for resource in host.resources}

    process_row, host_row, stale = rows()
    assert (process_row.state, process_row.stale, stale) == ("running", False, {False})
    assert host_row.accepting
    lose(cluster, "a", seconds=4.0)
    process_row, host_row, stale = rows()
    assert (host_row.state, stale, host_row.accepting) == ("suspect", {True}, False)
    assert (process_row.state, process_row.stale) == ("unknown", True)
    assert process_row.reason == "a has been silent for 4 s; last known: running"
    cluster.wait(10.0)
    process_row, host_row, stale = rows()
    assert (host_row.state, stale) == ("lost", {True})
    assert (process_row.state, process_row.stale) == ("unreachable", True)
    back(cluster, "a")
    process_row, host_row, stale = rows()
    assert (process_row.state, process_row.stale, stale) == ("running", False, {False})
