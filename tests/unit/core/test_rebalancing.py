"""Rebalancing: processes move to even out the load of the hosts."""

from __future__ import annotations

from typing import Any

from rosrm.core.master import events as happened
from rosrm.model.values import NeighbourRule, ProcessSpec
from tests.unit.core.cluster import MIB, Cluster, Machine, movable, process


def machine(name: str, memory: float = 0.0) -> Machine:
    """Return a host of 1000 MiB, of which 80 % may be used, and a part is used by others."""
    busy = {"memory": memory, "cpu": 0.0}
    return Machine(name, memory=1000 * MIB, cpu=64.0, busy=busy, limits={"memory": 0.8})


def on_a(*specs: ProcessSpec, **settings: Any) -> Cluster:
    """Return a cluster with these processes on a, to which b has joined after them."""
    known = {"hysteresis": 1.0, "cooldown": 5.0, "rebalance_after": 10.0, **settings}
    cluster = Cluster(machine("a"), **known)
    assert cluster.submit(*specs).accepted
    cluster.wait(1.0)
    cluster.add(machine("b"))
    return cluster


def four(**fields: Any) -> list[ProcessSpec]:
    return [movable(name, memory=180, **fields) for name in "pqrs"]


def rebalance(cluster: Cluster, *, plan_only: bool = False) -> str:
    return cluster.ask(happened.RebalanceRequested, plan_only).message


def test_without_the_setting_nothing_is_rebalanced() -> None:
    """This is the default."""
    cluster = on_a(*four())
    cluster.wait(60.0)
    assert cluster.counts() == {"a": 4, "b": 0}


def test_processes_move_to_a_host_that_joins() -> None:
    """Until the loads are even; the round is recorded with all of its moves."""
    cluster = on_a(*four(), rebalance=True)
    cluster.wait(3.0)
    assert cluster.counts() == {"a": 2, "b": 2}
    (said,) = cluster.recorded("rebalancing")
    assert said.splitlines() == [
        "the hosts are rebalanced: the loads of a (90%) and b (0%) differ most, by 90%",
        "move p from a (90% loaded, then 68%) to b (0%, then 22%)",
        "move q from a (68% loaded, then 45%) to b (22%, then 45%)",
    ]
    assert cluster.recorded("migration_begun")[0].endswith("the load of the hosts is evened out")


def test_a_spread_that_lasts_begins_a_round() -> None:
    """A peak within the time does not."""
    cluster = on_a(*four(), rebalance=True)
    cluster.wait(30.0)
    cluster.machines["a"].busy["memory"] = 0.4
    cluster.wait(9.0)
    cluster.machines["a"].busy["memory"] = 0.0
    cluster.wait(9.0)
    assert cluster.counts() == {"a": 2, "b": 2}
    cluster.machines["a"].busy["memory"] = 0.4
    cluster.wait(11.0)
    assert cluster.counts() == {"a": 1, "b": 3}


def test_rounds_follow_each_other_at_the_set_interval() -> None:
    """A round has at most `rebalance_moves` moves."""
    specs = [movable(f"p{i}", memory=70) for i in range(10)]
    cluster = on_a(*specs, rebalance=True, rebalance_moves=2, rebalance_spread=0.1)
    cluster.wait(5.0)
    assert cluster.counts() == {"a": 8, "b": 2}
    cluster.wait(5.0)
    assert cluster.counts() == {"a": 8, "b": 2}
    cluster.wait(30.0)
    assert cluster.counts() == {"a": 5, "b": 5}
    moves = len(cluster.recorded("migration_begun"))
    cluster.wait(100.0)
    assert len(cluster.recorded("migration_begun")) == moves


def test_at_most_max_migrations_are_in_progress() -> None:
    """The further moves of a round follow as the first ones end."""
    cluster = on_a(*four(), rebalance=True, max_migrations=1)
    cluster.machines["a"].stubborn.update("pqrs")
    cluster.wait(5.0)
    assert list(cluster.state.migrations) == ["p"]
    cluster.let_go("p")
    cluster.wait(1.0)
    assert list(cluster.state.migrations) == ["q"]


def test_a_plan_moves_nothing() -> None:
    """`rosrm rebalance` then does what its plan has said, also without the setting."""
    cluster = on_a(*four())
    said = rebalance(cluster, plan_only=True)
    assert said.splitlines()[1:] == [
        "move p from a (90% loaded, then 68%) to b (0%, then 22%)",
        "move q from a (68% loaded, then 45%) to b (22%, then 45%)",
    ]
    cluster.wait(5.0)
    assert (cluster.counts(), cluster.state.migrations) == ({"a": 4, "b": 0}, {})
    assert rebalance(cluster) == said
    cluster.wait(3.0)
    assert (cluster.where("p"), cluster.where("q")) == (["b"], ["b"])
    assert "nothing moves: " in rebalance(cluster)


def test_a_plan_leaves_no_trace_in_the_reservations() -> None:
    """A plan reserves the room of its moves only while the master makes the plan."""
    cluster = on_a(*four())
    before = cluster.state.hosts.cells.copy()
    rebalance(cluster, plan_only=True)
    assert (cluster.state.hosts.cells == before).all()


def test_protected_and_immovable_processes_stay() -> None:
    """The answer names the reasons."""
    cluster = on_a(movable("p", memory=300, protect=True), process("q", memory=300))
    assert rebalance(cluster).splitlines()[1] == (
        "nothing moves: p is protected; q has no migration strategy; give it `migration:` in its "
        "file"
    )


def test_a_process_in_its_cool_down_stays() -> None:
    """As after each move."""
    cluster = on_a(movable("p", memory=300), cooldown=30.0)
    cluster.migrate("p")
    cluster.migrate("p")
    assert "p is in its cool-down of 30 s after a move" in rebalance(cluster)


def test_processes_on_one_host_by_rule_move_together() -> None:
    """They count as two moves."""
    near = (NeighbourRule("near", ("p",)),)
    specs = (movable("p", memory=180), movable("q", memory=180, neighbours=near))
    cluster = on_a(*specs, *four()[2:])
    assert "move p and q from a" in rebalance(cluster)
    cluster.wait(3.0)
    assert (cluster.where("p"), cluster.where("q")) == (["b"], ["b"])


# --- moves of a round that begin later -----------------------------------------------------------


def half_begun(**settings: Any) -> Cluster:
    """Return a cluster where p moves from a to b, and q is to follow."""
    cluster = on_a(*four(), max_migrations=1, **settings)
    cluster.machines["a"].stubborn.update("pqrs")
    rebalance(cluster)
    cluster.wait(1.0)
    assert (list(cluster.state.migrations), cluster.state.rebalancing.pending) == (
        ["p"], [("q", "b")],
    )  # fmt: skip
    return cluster


def test_a_move_that_no_longer_evens_out_the_load_does_not_begin() -> None:
    """The destination may have got other work since the plan; then q would move back later."""
    cluster = half_begun()
    cluster.machines["b"].busy["memory"] = 0.35
    cluster.wait(1.0)
    cluster.let_go("p")
    cluster.wait(1.0)
    assert (cluster.where("q"), cluster.state.rebalancing.pending) == (["a"], [])
    (said,) = cluster.recorded("migration_refused")
    assert said == "q is not moved: its move would not even out the load of a and b any more"


def test_a_process_in_its_cool_down_does_not_move_later_in_the_round() -> None:
    """A user has moved it after the plan."""
    cluster = half_begun(cooldown=30.0)
    cluster.add(machine("c"))
    assert cluster.migrate("q", "c").accepted
    cluster.let_go("q")
    cluster.let_go("p")
    cluster.wait(1.0)
    assert (cluster.where("q"), cluster.state.rebalancing.pending) == (["c"], [])
    assert cluster.recorded("migration_refused") == [
        "q is not moved: q is in its cool-down of 30 s after a move"
    ]


def test_processes_on_one_host_by_rule_keep_to_the_bound_of_moves() -> None:
    """They begin together once there is room for both."""
    near = (NeighbourRule("near", ("q",)),)
    pair = movable("q", memory=100), movable("r", memory=100, neighbours=near)
    cluster = on_a(process("s", memory=300), movable("p", memory=180), *pair, max_migrations=2)
    cluster.machines["a"].stubborn.update("pqr")
    cluster.add(machine("c"))
    cluster.state.rebalancing.pending = [("p", "b"), ("q", "c")]
    cluster.wait(2.0)
    assert list(cluster.state.migrations) == ["p"]
    cluster.let_go("p")
    cluster.wait(0.5)
    assert sorted(cluster.state.migrations) == ["q", "r"]
