"""Loss and rejoin of hosts: the effect on their processes."""

from __future__ import annotations

from typing import Any

import pytest

from rosrm.core.master import events as happened
from rosrm.core.master import listing
from rosrm.core.master.settings import CoreSettings
from rosrm.core.slave import events
from rosrm.model.orders import AmendInstance, FenceInstance
from rosrm.model.values import (
    Amendment,
    HostLossPolicy,
    InstanceState,
    IsolationPolicy,
    Kind,
    Limits,
    MigrationPolicy,
    ProcessSpec,
    RestartPolicy,
    StandbyPolicy,
    StopPolicy,
)
from tests.unit.core.cluster import Cluster, movable, process
from tests.unit.core.machine import Machine

ELSEWHERE = HostLossPolicy("elsewhere")


def lose(cluster: Cluster, *names: str, seconds: float = 12.0) -> None:
    """Cut hosts off for longer than their lease."""
    cluster.cut(*names, seconds=seconds)


def on_a(spec: ProcessSpec, *others: str, full: bool = False, **settings: Any) -> Cluster:
    """Return a cluster in which a process runs on a; the others are cordoned if they are full."""
    cluster = Cluster("a", **settings).with_processes(spec)
    for name in others:
        cluster.add(name)
        if full:
            cluster.set_host(name, "cordon")
    cluster.wait(11.0)  # the master has had contact with some host for a whole lease
    assert cluster.where(spec.name) == ["a"]
    return cluster


def followed(*, full: bool = False, **fields: Any) -> Cluster:
    """Return a cluster in which p runs on a, and starts on b when a is lost."""
    fields.setdefault("host_loss", ELSEWHERE)
    return on_a(process("p", **fields), "b", full=full)


# --- host-loss policies -----------------------------------------------------------------------


def test_by_default_a_process_waits_for_its_host() -> None:
    """The process may still run there, so it waits for any time (here ten leases)."""
    cluster = on_a(process("p"), "b")
    lose(cluster, "a", seconds=100.0)
    assert (cluster.phase("p"), cluster["p"].reason) == ("unreachable", "a is lost")
    cluster.reconnect("a", seconds=1.0)
    assert (cluster.phase("p"), cluster.where("p")) == ("running", ["a"])


def test_elsewhere_starts_a_process_on_another_host_after_the_lease() -> None:
    """The successor starts as soon as the lease has expired, not before."""
    cluster = followed()
    lose(cluster, "a", seconds=9.5)
    assert cluster.where("p") == ["a"]
    cluster.wait(1.0)
    assert cluster.where("p") == ["a", "b"]
    assert (cluster.phase("p"), cluster["p"].owner) == ("running", 2)
    assert cluster.recorded("given_up") == ["p#1 is given up: a is lost"]


def test_elsewhere_waits_for_its_delay() -> None:
    """The reason names the delay."""
    cluster = followed(host_loss=HostLossPolicy("elsewhere", 20.0))
    lose(cluster, "a", seconds=25.0)
    assert cluster["p"].reason == "a is lost; the process is started on another host in 20 s"
    assert cluster.where("p") == ["a"]
    cluster.wait(6.0)
    assert cluster.where("p") == ["a", "b"]


def test_stop_makes_a_process_fail() -> None:
    """The process has no successor, and is stopped when its host rejoins."""
    cluster = followed(host_loss=HostLossPolicy("stop"))
    lose(cluster, "a")
    assert (cluster.phase("p"), cluster["p"].reason) == ("failed", "a is lost")
    assert cluster.where("p") == ["a"]
    cluster.reconnect("a", seconds=1.0)
    assert cluster.where("p") == []


# --- rejoin -----------------------------------------------------------------------------------


@pytest.mark.parametrize("restarted", [False, True], ids=["same master", "restarted master"])
def test_the_old_instance_is_fenced_when_its_host_rejoins(restarted: bool) -> None:
    """The new instance owns the name, so the old one ends at once, without its stop time.

    A restarted master fences an instance that its journal does not contain.
    """
    cluster = followed()
    cluster.machines["a"].stubborn.add("p")
    lose(cluster, "a")
    if restarted:
        cluster.restart_master()
        assert cluster.phase("p") == "running"
        cluster.rejoin("a", 0.2)
    cluster.reconnect("a", seconds=0.2)
    assert cluster.where("p") == ["b"]
    assert [order.instance.number for order in cluster.orders(FenceInstance)] == [1]
    (message, *_) = cluster.recorded("fenced")
    assert message.startswith("p#1 is not assigned to a: the master fences it")


@pytest.mark.parametrize("restarted", [False, True], ids=["same master", "restarted master"])
def test_a_process_without_a_successor_is_readopted(restarted: bool) -> None:
    """With no room elsewhere, the process leaves the queue and keeps running untouched."""
    cluster = followed(full=True)
    lose(cluster, "a")
    assert (cluster.phase("p"), cluster.queue()) == ("queued", ["p"])
    if restarted:
        cluster.restart_master()
        cluster.rejoin("a", 0.0)
    cluster.reconnect("a", seconds=1.0)
    assert (cluster.phase("p"), cluster["p"].owner, cluster.queue()) == ("running", 1, [])
    assert cluster.where("p") == ["a"]
    assert not cluster.orders(FenceInstance)
    cluster.set_host("b", "uncordon")
    cluster.cancel("p")
    assert (cluster.phase("p"), cluster.where("p")) == ("cancelled", [])


@pytest.mark.parametrize(("code", "phase"), [(0, "finished"), (3, "failed")])
def test_an_end_on_a_lost_host_is_final(code: int, phase: str) -> None:
    """A job without a successor is not run again; the host has applied its restart policy."""
    cluster = followed(kind=Kind.JOB, full=True)
    lose(cluster, "a")
    cluster.machines["a"].finish("p", cluster.now, code=code)
    cluster.reconnect("a", seconds=1.0)
    assert (cluster.phase("p"), cluster["p"].exit_code, cluster.queue()) == (phase, code, [])


def test_a_process_that_is_missing_on_a_returned_host_starts_again() -> None:
    """A host that lost its power rejoins without the process."""
    cluster = followed(full=True)
    lose(cluster, "a")
    cluster.machines["a"].programs.clear()
    cluster.restart_slave("a")
    cluster.wait(1.0)
    assert (cluster.phase("p"), cluster["p"].owner, cluster.where("p")) == ("running", 2, ["a"])


# --- lost host or isolated master -------------------------------------------------------------


def test_a_master_without_contact_to_any_host_gives_nothing_up() -> None:
    """A host that rejoins within a lease of the first host keeps its processes."""
    cluster = followed()
    lose(cluster, "a", "b", seconds=60.0)
    assert (cluster.phase("p"), cluster.recorded("given_up")) == ("unreachable", [])
    cluster.reconnect("b", seconds=8.0)
    cluster.reconnect("a", seconds=1.0)
    assert (cluster.phase("p"), cluster.where("p")) == ("running", ["a"])
    assert not cluster.recorded("given_up")


def test_a_host_that_stays_away_after_the_rejoin_of_others_is_given_up() -> None:
    """The host is given up one lease after the first host rejoined."""
    cluster = followed()
    lose(cluster, "a", "b", seconds=60.0)
    cluster.reconnect("b", seconds=12.0)
    assert cluster.where("p") == ["a", "b"]


def test_a_restarted_master_gives_the_hosts_their_lease_first() -> None:
    """A new master has had no contact yet, so silence counts from its start."""
    cluster = followed()
    cluster.machines["a"].connected = False
    cluster.restart_master()
    cluster.wait(9.0)
    assert cluster.where("p") == ["a"]
    cluster.wait(3.0)
    assert cluster.where("p") == ["a", "b"]


# --- instances that do not own the name -------------------------------------------------------


BEING_CANCELLED = "being cancelled; it may still run on a, which is lost, and ends when a returns"


@pytest.mark.parametrize(
    "policy",
    [HostLossPolicy(), HostLossPolicy("stop", 50.0), HostLossPolicy("elsewhere", 20.0)],
    ids=lambda one: one.then,
)
def test_a_process_on_a_lost_host_is_being_cancelled_until_the_host_reports_its_end(
    policy: HostLossPolicy,
) -> None:
    """The process may still run there, so its name stays taken until then.

    A fence of `isolation: keep` ends nothing while the slave runs.
    """
    cluster = followed(host_loss=policy)
    lose(cluster, "a")
    assert cluster.cancel("p").message == f"1 process being cancelled; p is {BEING_CANCELLED}"
    cluster.wait(100.0)
    assert (cluster.phase("p"), cluster["p"].reason) == ("stopping", BEING_CANCELLED)
    assert BEING_CANCELLED in cluster.submit(process("p")).message
    cluster.reconnect("a", seconds=1.0)
    assert (cluster.phase("p"), cluster.where("p")) == ("cancelled", [])


def test_a_process_that_is_being_cancelled_when_its_host_is_lost_has_the_reason() -> None:
    """The reason is kept over a restart of the master."""
    cluster = on_a(process("p"), "b")
    cluster.machines["a"].stubborn.add("p")
    cluster.cancel("p")
    lose(cluster, "a")
    assert (cluster.phase("p"), cluster["p"].reason) == ("stopping", BEING_CANCELLED)
    cluster.kill_master()
    assert cluster.phase("p") == "stopping"
    assert "a, which has not reported since the master started" in cluster["p"].reason
    cluster.machines["a"].let_go("p", cluster.now)
    cluster.rejoin("a")
    assert cluster.phase("p") == "cancelled"


@pytest.mark.parametrize(
    ("isolation", "before", "after"),
    [(IsolationPolicy("stop"), 0.0, 20.0), (IsolationPolicy("stop", 60.0), 48.0, 6.0)],
    ids=["delay", "later fence"],
)
def test_a_process_is_cancelled_when_its_fence_has_ended_it(
    isolation: IsolationPolicy, before: float, after: float
) -> None:
    """With `elsewhere` the process ended before a successor could have started.

    Its own `isolation.after` counts from the last contact that its host knows of.
    """
    cluster = followed(host_loss=HostLossPolicy("elsewhere", 20.0), isolation=isolation)
    lose(cluster, "a")
    cluster.cancel("p")
    cluster.wait(before)  # the lease of 10 s expired 2 s before that
    assert cluster.phase("p") == "stopping"
    cluster.wait(after)
    assert cluster.phase("p") == "cancelled"


def test_the_loss_of_the_source_after_the_commit_does_not_block_a_move() -> None:
    """The destination owns the name; the source is fenced when its host rejoins."""
    cluster = on_a(movable("p"), "b")
    cluster.machines["a"].stubborn.add("p")
    cluster.migrate("p")
    assert cluster["p"].owner == 2
    assert cluster.phase("p") == "migrating"
    lose(cluster, "a", seconds=15.0)
    assert cluster.phase("p") == "running"
    cluster.reconnect("a", seconds=0.5)
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


def test_a_process_that_may_have_a_successor_is_fenced_without_its_slave() -> None:
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


def test_the_time_of_an_isolation_policy_applies() -> None:
    """A process without a successor gets its whole grace, too."""
    assert fence(HostLossPolicy(), IsolationPolicy("stop", 7.0)) == (7.0, 3.0)
    assert fence(HostLossPolicy(), IsolationPolicy("stop")) == (CoreSettings().lease, 3.0)
    assert fence(ELSEWHERE, IsolationPolicy("stop", 100.0)) == (100.0, 0.0)


def test_beats_name_the_hosts_without_contact() -> None:
    """Beats name suspect, lost and detached hosts, not expected ones or those that have left.

    A slave that is still stopping must not take a beat as contact with the master.
    """
    cluster = Cluster(*"abcd").with_processes(*(process(name) for name in "pqrs"))
    assert cluster.state.hosts.silent_hosts() == []
    lose(cluster, "b", seconds=2.0)
    lose(cluster, "c", seconds=10.0)
    cluster.detach("d")
    assert cluster.state.hosts.silent_hosts() == [2, 3, 4]
    cluster.reconnect("b", seconds=1.0)
    assert cluster.state.hosts.silent_hosts() == [3, 4]


@pytest.mark.parametrize(("then", "phase"), [("wait", "running"), ("stop", "failed")])
def test_a_process_that_its_host_fenced_follows_its_policy(then: str, phase: str) -> None:
    """The host was cut off only briefly and never lost, so the process has no successor."""
    cluster = followed(host_loss=HostLossPolicy(then))
    machine = cluster.machines["a"]
    machine._end(machine.find("p"), InstanceState.FENCED, cluster.now, signal=9)
    cluster.settle()
    assert cluster.phase("p") == phase


def test_a_readopted_process_has_its_restart_policy_again() -> None:
    """A move in progress at the loss had ordered the slave not to restart the process."""
    cluster = on_a(process("p", restart=RestartPolicy("on-failure"), host_loss=ELSEWHERE))
    cluster.add(Machine("b", busy={"memory": 0.9}))  # a host in contact, without room
    cluster.wait(11.0)
    a = cluster.machines["a"]
    a.tell(events.AmendmentOrdered(a.find("p"), Amendment(RestartPolicy("never"))), cluster.now)
    lose(cluster, "a")
    assert cluster.phase("p") == "queued"
    cluster.reconnect("a", seconds=1.0)
    assert (cluster.phase("p"), cluster.where("p")) == ("running", ["a"])
    amended = [one.amendment.restart for one in cluster.orders(AmendInstance)]
    assert amended == [RestartPolicy("on-failure")]


@pytest.mark.parametrize("ends", [False, True], ids=["runs on", "ends"])
def test_a_readopted_process_whose_restarts_a_move_turned_off_is_restarted(ends: bool) -> None:
    """The order is sent without the limits, which the slave refuses, or after the end."""
    cluster = on_a(
        process("p", restart=RestartPolicy("on-failure"), host_loss=ELSEWHERE,
                migration=MigrationPolicy("handoff"), limits=Limits(memory=1e9)),
    )  # fmt: skip
    a = cluster.machines["a"]
    a.uses = 2e9
    cluster.add(Machine("b"))
    a.quirks["p"].add("never silent")
    cluster.migrate("p", "b")
    assert cluster.state.instances[1].restarts_off
    cluster.add(Machine("c", busy={"memory": 0.9}))
    cluster.cut("a", "b", seconds=60.0)
    assert cluster.phase("p") == "queued"
    if ends:
        a.finish("p", cluster.now, code=3)
    cluster.reconnect("a", seconds=2.0)
    assert (cluster.phase("p"), cluster["p"].owner) == ("running", 4 if ends else 1)
    assert a.programs[a.find("p")].restart == RestartPolicy("on-failure")


def test_a_process_that_was_cancelled_while_its_host_was_lost_is_not_readopted() -> None:
    """The process is queued again; the old instance is ordered to end."""
    cluster = followed(full=True)
    lose(cluster, "a")
    cluster.cancel("p")
    cluster.restart("p")
    cluster.reconnect("a", seconds=1.0)
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
    cluster.set_host("b", "uncordon")
    cluster.wait(0.5)
    assert (cluster.phase("p"), cluster.queue()) == ("queued", ["p"])
    assert cluster["p"].reason == "waits until p#1 on a has ended"
    cluster.machines["a"].let_go("p", cluster.now)
    cluster.wait(0.5)
    assert (cluster.phase("p"), cluster["p"].owner) == ("running", 2)


# --- what is shown ----------------------------------------------------------------------------


def test_rows_of_a_silent_host_are_stale() -> None:
    """From the first silence on every row shows old readings; after the rejoin all is current."""
    cluster = on_a(process("p"), "b")

    def rows() -> Any:
        (process,) = listing.process_rows(cluster.state, cluster.now)
        host = listing.host_rows(cluster.state, cluster.now)[0]
        return process.state, process.stale, host.state, {one.stale for one in host.resources}

    assert rows() == ("running", False, "up", {False})
    assert listing.host_rows(cluster.state, cluster.now)[0].accepting
    lose(cluster, "a", seconds=4.0)
    assert rows() == ("unknown", True, "suspect", {True})
    assert not listing.host_rows(cluster.state, cluster.now)[0].accepting
    (row,) = listing.process_rows(cluster.state, cluster.now)
    assert row.reason == "a has been silent for 4 s; last known: running"
    assert row.since == pytest.approx(4.0, abs=0.5)
    assert cluster.explain("p")["reason"] == row.reason
    cluster.wait(10.0)
    assert rows() == ("unreachable", True, "lost", {True})
    cluster.reconnect("a", seconds=1.0)
    assert rows() == ("running", False, "up", {False})
