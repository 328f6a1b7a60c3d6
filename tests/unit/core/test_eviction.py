"""Eviction and drain: choice of the process that leaves a host, and reasons against it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import pytest

from rosrm.core.master import listing
from rosrm.model.values import HostLossAction, HostLossPolicy, ResourceDescription
from tests.unit.core.cluster import GIB, MIB, Cluster, Machine, movable, process


def machine(name: str, memory: float = 0.1) -> Machine:
    """Return a host with 1000 MiB and 4 cores, 80 % of each allowed."""
    return Machine(
        name, memory=1000 * MIB, cpu=4.0, busy={"memory": memory, "cpu": 0.05},
        limits={"memory": 0.8, "cpu": 0.8},
    )  # fmt: skip


def cluster_of(*machines: Machine, **settings: Any) -> Cluster:
    return Cluster(*machines, **{"settle": 1.0, "hysteresis": 2.0, "cooldown": 30.0, **settings})


def on_a(memory: Mapping[str, float], *others: Machine, **settings: Any) -> Cluster:
    """Return a cluster where processes run on a and use this memory, MiB; others join later."""
    cluster = cluster_of(machine("a"), **settings)
    for name, used in memory.items():
        cluster.machines["a"].shown[name] = {"memory": used * MIB}
        cluster.submit(movable(name))
        assert cluster.where(name) == ["a"]
    cluster.wait(1.5)
    for other in others:
        cluster.add(other)
    return cluster


def test_the_largest_user_leaves_a_host_over_its_limit() -> None:
    """One process leaves, the largest user of that resource, to a host with room."""
    cluster = on_a({"small": 50, "large": 300, "middle": 200}, machine("b"))
    cluster.machines["a"].busy["memory"] = 0.3
    cluster.wait(3.0)
    assert cluster.where("large") == ["b"]
    assert cluster.counts() == {"a": 2, "b": 1}
    assert cluster.recorded("over_limit") == ["a reached its limit of memory"]
    (said,) = cluster.recorded("migration_begun")
    assert said == "large moves from a to b by relaunch: a is over its limit of memory"
    assert cluster.explain("large")["decision"]["kind"] == "migrated"


def test_a_stale_reading_neither_exceeds_nor_meets_a_limit() -> None:
    """A stale reading does not fall when processes leave, so it would evict all of them.

    It does not show the host under its limit either.
    """
    cluster = on_a({"large": 300, "middle": 200}, machine("b"))
    cluster.machines["a"].stale.add("memory")
    cluster.machines["a"].busy["memory"] = 0.5
    cluster.wait(5.0)
    assert cluster.recorded("over_limit") == []
    assert cluster.counts() == {"a": 2, "b": 0}
    cluster.machines["a"].stale.clear()
    cluster.wait(0.5)
    cluster.machines["a"].stale.add("memory")
    cluster.wait(5.0)
    assert cluster.recorded("over_limit") == ["a reached its limit of memory"]
    assert cluster.recorded("under_limit") == []
    assert cluster.counts() == {"a": 2, "b": 0}


def test_a_reading_that_crosses_the_limit_each_second_is_recorded_once() -> None:
    """The end is recorded once the host has been under its limits for the hysteresis."""
    cluster = cluster_of(machine("a"))
    for _ in range(10):
        for memory in (0.9, 0.3):
            cluster.machines["a"].busy["memory"] = memory
            cluster.wait(1.0)
    assert cluster.recorded("over_limit") == ["a reached its limit of memory"]
    assert cluster.recorded("under_limit") == []
    cluster.wait(1.5)
    assert cluster.recorded("under_limit") == ["a is under its limits"]


def test_a_silent_host_is_not_recorded_as_under_its_limits() -> None:
    """Only a new reading shows on which side of its limit the host is."""
    cluster = cluster_of(machine("a", memory=0.9), machine("b"))
    cluster.wait(1.0)
    cluster.cut("a", seconds=6.0)
    assert (len(cluster.recorded("over_limit")), cluster.recorded("under_limit")) == (1, [])
    cluster.machines["a"].busy["memory"] = 0.1
    cluster.reconnect("a", seconds=4.0)
    assert cluster.recorded("under_limit") == ["a is under its limits"]


def test_a_limit_that_no_process_can_relieve_does_not_hide_another() -> None:
    """The CPU load is not rosrm's; the memory limit is exceeded later, and is relieved."""
    cluster = on_a({"p": 300}, machine("b"))
    cluster.machines["a"].busy["cpu"] = 0.9
    cluster.wait(3.0)
    assert cluster.recorded("nothing_moves") == ["nothing can leave a: p uses no cpu"]
    cluster.machines["a"].busy["memory"] = 0.6
    cluster.wait(3.0)
    assert cluster.where("p") == ["b"]


def test_the_process_that_leaves_uses_the_exceeded_resource() -> None:
    """A process that uses no CPU does not leave a host over its CPU limit."""
    cluster = on_a({"fat": 400, "busy": 10})
    cluster.machines["a"].shown["busy"]["cpu"] = 1.0
    cluster.add(machine("b"))
    cluster.wait(0.3)
    cluster.machines["a"].busy["cpu"] = 0.7
    cluster.wait(3.0)
    assert (cluster.where("busy"), cluster.where("fat")) == (["b"], ["a"])


def test_the_process_that_leaves_fits_at_the_destination() -> None:
    """The largest process that fits leaves; a destination keeps its headroom below the limit."""
    cluster = on_a({"large": 300, "small": 100}, headroom=0.05)
    cluster.add(machine("b", memory=0.5))  # 0.5 + 0.3 reaches the limit, without headroom
    cluster.machines["a"].busy["memory"] = 0.45
    cluster.wait(3.0)
    assert (cluster.where("small"), cluster.where("large")) == (["b"], ["a"])


def test_nothing_moves_when_every_host_is_at_its_limits() -> None:
    """Nothing is assigned either: the queue waits."""
    cluster = on_a({"p": 300}, machine("b", memory=0.2))
    for name in "ab":
        cluster.machines[name].busy["memory"] = 0.85
    cluster.wait(5.0)
    cluster.submit(movable("q"))
    assert (cluster.where("p"), cluster.queue()) == (["a"], ["q"])
    assert cluster.recorded("nothing_moves")[0] == "nothing can leave a: no host has room for p"


def test_a_full_resource_without_a_limit_is_no_reason_to_move() -> None:
    """A reading of exactly 1 is not over a limit that was never set."""
    cluster = cluster_of(Machine("a", limits={"memory": 0.8}))
    cluster.machines["a"].shown["p"] = {"cpu": 0.8}
    cluster.submit(movable("p"))
    cluster.wait(1.5)
    cluster.add(machine("b"))
    cluster.machines["a"].busy["cpu"] = 0.9
    assert cluster.machines["a"].usage(cluster.now)["cpu"] == 1.0
    cluster.wait(5.0)
    assert cluster.recorded("over_limit") == []
    assert cluster.where("p") == ["a"]


def test_a_host_over_its_limit_within_the_hysteresis_keeps_its_processes() -> None:
    """Nothing moves within the hysteresis."""
    cluster = on_a({"p": 300}, machine("b"), hysteresis=2.0)
    for _ in range(3):
        cluster.machines["a"].busy["memory"] = 0.6
        cluster.wait(1.5)
        cluster.machines["a"].busy["memory"] = 0.1
        cluster.wait(0.5)
    assert cluster.where("p") == ["a"]
    cluster.wait(2.0)
    assert cluster.recorded("under_limit")


def test_a_process_that_moved_stays_for_its_cool_down() -> None:
    """The cool-down keeps a process from flapping between two full hosts."""
    cluster = on_a({"p": 300}, machine("b"), cooldown=30.0)
    cluster.machines["a"].busy["memory"] = 0.6
    cluster.wait(3.0)
    assert cluster.where("p") == ["b"]
    cluster.machines["a"].busy["memory"] = 0.1
    cluster.machines["b"].busy["memory"] = 0.6
    cluster.machines["b"].shown["p"] = {"memory": 300 * MIB}
    cluster.wait(20.0)
    assert cluster.where("p") == ["b"]
    assert "p is in its cool-down of 30 s after a move" in cluster.recorded("nothing_moves")[-1]
    cluster.wait(12.0)
    assert cluster.where("p") == ["a"]


def test_one_process_at_a_time_leaves_a_host() -> None:
    """After each move the hysteresis starts again before the next process leaves."""
    cluster = on_a({"p": 150, "q": 150, "r": 150}, machine("b"))
    cluster.machines["a"].busy["memory"] = 0.9
    cluster.wait(2.5)
    assert cluster.counts() == {"a": 2, "b": 1}
    cluster.wait(1.0)
    assert cluster.counts() == {"a": 2, "b": 1}
    cluster.wait(1.5)
    assert cluster.counts() == {"a": 1, "b": 2}


def test_at_most_max_migrations_are_in_progress() -> None:
    """The limit holds for the whole cluster."""
    cluster = cluster_of(machine("a"), max_migrations=2)
    for name in "pqrs":
        cluster.submit(movable(name, ros=True))
        cluster.machines["a"].seen_in_graph(name, cluster.now)
        cluster.settle()
    cluster.add(machine("b"))
    cluster.set_host("a", "drain")
    cluster.wait(1.0)
    assert len(cluster.state.migrations) == 2
    for name in list(cluster.state.migrations):
        cluster.machines["b"].seen_in_graph(name, cluster.now)
    cluster.settle()
    cluster.wait(0.4)
    assert len(cluster.state.migrations) == 2
    assert cluster.counts()["b"] == 4


def test_all_movable_processes_leave_a_draining_host() -> None:
    """The reply and the record name the processes that cannot leave, with the reason."""
    cluster = on_a({"p": 50, "q": 50})
    cluster.submit(process("fixed"), process("rooted"))
    cluster.add(machine("b"))
    stays = (
        "leave: each of fixed and rooted has no migration strategy; give it `migration:` in its "
        "file"
    )
    said = cluster.set_host("a", "drain").message
    assert said == f"a is draining: 2 processes leave (p and q); cannot {stays}"
    cluster.wait(3.0)
    assert cluster.counts() == {"a": 2, "b": 2}
    assert cluster.recorded("host_drained") == [f"a is drained: nothing can {stays}"]
    assert listing.host_rows(cluster.state, cluster.now)[0].drained
    cluster.submit(process("new"))
    assert cluster.where("new") == ["b"]


def test_a_host_is_drained_when_all_movable_processes_have_left() -> None:
    """The drain waits while no host has room or the host is lost; a new process ends the state."""
    cluster = on_a({"p": 50}, machine("b"))
    cluster.set_host("b", "cordon")
    cluster.set_host("a", "drain")
    cluster.wait(3.0)
    assert "no host can take p: b is cordoned" in cluster.recorded("nothing_moves")[0]
    cluster.machines["a"].connected = False
    cluster.set_host("b", "uncordon")
    cluster.wait(12.0)
    assert cluster.recorded("host_drained") == []
    cluster.reconnect("a", seconds=5.0)
    assert (cluster.where("p"), len(cluster.recorded("host_drained"))) == (["b"], 1)
    cluster.set_host("a", "uncordon")
    assert not listing.host_rows(cluster.state, cluster.now)[0].drained


def test_the_answer_to_a_drain_says_what_cannot_leave_yet() -> None:
    """A host that is full, closed or silent may change, so these processes wait to leave."""
    cluster = on_a({"p": 50, "q": 50}, machine("b"))
    cluster.set_host("b", "drain")
    said = cluster.set_host("a", "drain").message
    each = "no host can take p: b is being drained; no host can take q: b is being drained"
    assert said == f"a is draining: 2 processes cannot leave yet: {each}"
    cluster.cut("a", seconds=20.0)
    cluster.set_host("b", "uncordon")
    unreachable = "each of p and q is unreachable; only a running process can be moved"
    said = cluster.set_host("a", "drain").message
    unknown = "the other processes there are not known, because the host is lost"
    assert said == f"a is draining: 2 processes cannot leave yet: {unreachable}; {unknown}"


@pytest.mark.parametrize("then", ["elsewhere", "stop"])
def test_the_answer_to_a_drain_of_a_lost_host_claims_nothing(then: HostLossAction) -> None:
    """Processes may still run on the lost host, even if they run elsewhere by now."""
    cluster = Cluster("a", "b", suspect=1.0, lease=3.0)
    cluster.submit(process("p", host_loss=HostLossPolicy(then)))
    (host,) = cluster.where("p")
    cluster.cut(host, seconds=10.0)
    said = cluster.set_host(host, "drain").message
    unknown = "the processes there are not known, because the host is lost"
    assert said == f"{host} is draining: {unknown}"
    cluster.wait(3.0)
    assert not cluster.recorded("host_drained")


def test_a_process_that_no_other_host_may_take_stays_on_a_draining_host() -> None:
    """The host counts as drained until a host registers that may take the process."""
    cluster = cluster_of(Machine("a", labels={"camera": "front"}), machine("b"))
    cluster.submit(movable("p", required_labels={"camera": "front"}))
    said = cluster.set_host("a", "drain").message
    assert said.endswith(
        "nothing can leave: p may run on no other host: b lacks the label camera=front"
    )
    cluster.wait(3.0)
    assert len(cluster.recorded("host_drained")) == 1
    cluster.add(Machine("c", labels={"camera": "front"}))
    cluster.wait(3.0)
    assert cluster.where("p") == ["c"]


def test_a_process_too_large_for_every_other_host_stays_on_a_draining_host() -> None:
    """Such a process would wait for room forever."""
    cluster = cluster_of(machine("a"), Machine("small", memory=100 * MIB))
    cluster.submit(movable("p", needs={"memory": 400 * MIB}))
    assert cluster.where("p") == ["a"]
    assert "nothing can leave: p may run on no other" in cluster.set_host("a", "drain").message
    cluster.wait(3.0)
    assert len(cluster.recorded("host_drained")) == 1


def test_the_lack_of_another_host_is_one_reason() -> None:
    """Both a command and a drain name the missing host, not missing room."""
    cluster = on_a({"p": 50, "q": 50})
    assert cluster.migrate("p").message == "there is no other host"
    said = cluster.set_host("a", "drain").message
    assert said == "a is draining: nothing can leave: there is no other host"


def test_without_automatic_no_process_is_evicted() -> None:
    """Drain and `migrate` still move processes."""
    cluster = on_a({"p": 300}, machine("b"), automatic=False)
    cluster.machines["a"].busy["memory"] = 0.6
    cluster.wait(5.0)
    assert cluster.where("p") == ["a"]
    assert cluster.migrate("p").accepted
    assert cluster.where("p") == ["b"]


def test_a_reason_against_eviction_is_recorded_once() -> None:
    """The reason is recorded again when the host exceeds its limit again, not every ten seconds."""
    cluster = on_a({"p": 300})
    cluster.machines["a"].busy["memory"] = 0.6
    cluster.wait(60.0)
    assert len(cluster.recorded("nothing_moves")) == 1
    cluster.machines["a"].busy["memory"] = 0.1
    cluster.wait(20.0)
    cluster.machines["a"].busy["memory"] = 0.6
    cluster.wait(20.0)
    assert len(cluster.recorded("nothing_moves")) == 2


def test_a_move_goes_to_the_largest_margin() -> None:
    """The order of hosts is the same as for a new process."""
    cluster = on_a({"p": 100})
    cluster.add(machine("b", memory=0.4))
    cluster.add(machine("c", memory=0.2))
    cluster.migrate("p")
    assert cluster.where("p") == ["c"]


@pytest.mark.parametrize("resource", ["memory", "cpu"])
def test_eviction_counts_the_measured_usage(resource: str) -> None:
    """The relief is the measured usage, not the declared needs."""
    cluster = cluster_of(machine("a"))
    cluster.machines["a"].shown["p"] = {"memory": 300 * MIB, "cpu": 1.6}
    cluster.machines["a"].shown["q"] = {"memory": 10 * MIB, "cpu": 0.1}
    cluster.submit(movable("p", needs={"memory": 1.0 * MIB, "cpu": 0.0}))
    cluster.submit(movable("q", needs={"memory": 0.1 * GIB, "cpu": 0.3}))
    cluster.wait(1.5)
    cluster.add(machine("b"))
    cluster.machines["a"].busy[resource] = 0.6
    cluster.wait(3.0)
    assert (cluster.where("p"), cluster.where("q")) == (["b"], ["a"])


# --- the paper's Fig. 10: equal hosts, and a process that grows beyond the limit of each ----------


def equal_hosts(**settings: Any) -> Cluster:
    """Return three equal hosts, on one of which a process begins with 100 MiB."""
    cluster = cluster_of(machine("a"), machine("b"), machine("c"), **settings)
    cluster.submit(movable("p", memory=100))
    grow(cluster, to=100)
    return cluster


def grow(cluster: Cluster, *, to: float) -> str:
    """Let the process use so many MiB where it runs; return the name of that host."""
    (host,) = cluster.where("p")
    cluster.machines[host].shown["p"] = {"memory": to * MIB}
    cluster.wait(1.5)
    return host


def test_a_process_that_fills_a_host_leaves_it_for_an_equal_one_by_its_declared_need() -> None:
    """Relaunched, it begins with its need again; after the cool-down it moves on."""
    cluster = equal_hosts(need="declared")
    for moves in (1, 2):
        source = grow(cluster, to=750)
        cluster.wait(3.0)
        (there,) = cluster.where("p")
        assert there != source
        assert cluster["p"].migrations == moves
        cluster.machines[source].shown.clear()
        cluster.wait(30.0)
    assert cluster.recorded("nothing_moves") == []


def test_a_process_that_fills_a_host_stays_by_its_measured_need() -> None:
    """An equal host has no room for all that it uses."""
    cluster = equal_hosts(need="measured")
    source = grow(cluster, to=750)
    cluster.wait(10.0)
    assert cluster.where("p") == [source]
    assert cluster.recorded("nothing_moves")[0].endswith("no host has room for p")


def test_by_its_measured_need_a_process_leaves_before_it_is_too_large() -> None:
    """Another program fills the host, and the equal hosts have room for what the process uses."""
    cluster = equal_hosts(need="measured")
    source = grow(cluster, to=600)
    cluster.machines[source].busy["memory"] = 0.3
    cluster.wait(3.0)
    assert cluster.where("p") != [source]


@pytest.mark.parametrize(("seconds", "moves"), [(1.0, 0), (4.0, 1)])
def test_a_peak_within_the_hysteresis_moves_nothing_also_by_the_declared_need(
    seconds: float, moves: int
) -> None:
    """The hysteresis, not the judgement at the destination, decides whether a peak counts."""
    cluster = equal_hosts(need="declared", hysteresis=3.0)
    (source,) = cluster.where("p")
    cluster.machines[source].shown["p"] = {"memory": 750 * MIB}
    cluster.wait(seconds)
    cluster.machines[source].shown["p"] = {"memory": 100 * MIB}
    cluster.wait(5.0)
    assert cluster["p"].migrations == moves


def test_a_resource_without_a_probe_prevents_no_move() -> None:
    """Slaves report CPU usage per process even where no probe measures the host's CPU."""
    memory = (ResourceDescription("memory", "B", 16 * GIB),)
    cluster = Cluster(*(Machine(name, resources=memory) for name in ("a", "b")))
    for machine in cluster.machines.values():
        machine.shown["p"] = {"memory": 50 * MIB, "cpu": 0.5}
    cluster.submit(movable("p"))
    cluster.wait(2.0)
    assert cluster.migrate("p").accepted
