"""Circles of start orders: none comes into force, and one of an older journal ends no master."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

import rosrm
from rosrm.core.master.dependants import dependants_first, orders_from
from rosrm.model.dependencies import in_order
from rosrm.model.orders import StopInstance
from rosrm.model.values import ProcessSpec, StartOrder
from tests.unit.core.cluster import Cluster, movable, process


def after(spec: ProcessSpec, *names: str) -> ProcessSpec:
    return replace(spec, start_order=StartOrder(dict.fromkeys(names, "ready")))


def failing(spec: ProcessSpec) -> ProcessSpec:
    """Return another version, which needs a new start."""
    return replace(spec, command=("new",))


def during_a_rollout() -> Cluster:
    """Return a cluster whose application `one` replaces the version with `a` after `b`."""
    cluster = Cluster("h")
    cluster.apply("two", process("b"))
    cluster.apply("one", after(movable("a"), "b"))
    cluster.wait(2.0)
    assert cluster.apply("one", failing(movable("a")), healthy_for=20.0).accepted
    cluster.wait(2.0)
    return cluster


def test_a_return_that_would_close_a_circle_pauses() -> None:
    """The former version starts `a` after `b`, which starts after `a` since."""
    cluster = during_a_rollout()
    assert cluster.apply("two", after(process("b"), "a")).accepted
    cluster.finish("a", "h", code=1)
    cluster.wait(10.0)
    one = cluster.state.applications["one"]
    assert one.wanted == 2
    assert "the former version 1 does not return: after: a -> b -> a is a circle" in one.paused
    assert "one is paused: a: it failed" in cluster.recorded("application_failed")[-1]
    assert not cluster.recorded("application_returns")
    assert cluster.cancel("a", "b").accepted
    cluster.wait(2.0)
    assert cluster.phase("b") == "cancelled"


def test_a_return_without_a_circle_takes_place() -> None:
    cluster = during_a_rollout()
    cluster.finish("a", "h", code=1)
    cluster.wait(10.0)
    assert cluster.state.applications["one"].wanted == 1


def test_an_order_that_is_not_in_force_yet_counts() -> None:
    """The former `a` is still being stopped, so the desired one is not there yet."""
    cluster = Cluster("h")
    cluster.apply("two", process("b"))
    cluster.apply("one", process("a"))
    cluster.wait(2.0)
    cluster.machines["h"].stubborn.add("a")
    cluster.cancel("a")
    assert cluster.apply("one", after(process("a"), "b")).accepted
    reply = cluster.apply("two", after(process("b"), "a"))
    assert not reply.accepted
    assert orders_from(cluster.state, [after(process("b"), "a")])["a"] == ["b"]


def test_a_paused_version_counts() -> None:
    """Its unfinished work continues at the next request."""
    cluster = Cluster("h")
    cluster.apply("two", process("b"))
    cluster.apply("one", movable("a"), movable("c"))
    cluster.wait(2.0)
    cluster.machines["h"].stubborn.add("a")
    cluster.cancel("a")
    parts = failing(movable("c")), after(movable("a"), "b")
    cluster.apply("one", *parts, healthy_for=20.0, on_failure="pause")
    cluster.wait(2.0)
    cluster.finish("c", "h", code=1)
    cluster.wait(2.0)
    assert cluster.state.applications["one"].paused
    cluster.let_go("a", "h")
    cluster.wait(1.0)
    assert orders_from(cluster.state, [after(process("b"), "a")])["a"] == ["b"]


def test_the_version_that_an_instance_is_being_replaced_by_counts() -> None:
    """Its order comes into force with the commit, whatever is requested since."""
    cluster = Cluster("h")
    cluster.apply("two", process("b"))
    cluster.apply("one", movable("a"))
    cluster.wait(2.0)
    cluster.machines["h"].connected = False
    cluster.apply("one", after(failing(movable("a")), "b"))
    cluster.apply("one", failing(movable("a")))
    assert "a" in cluster.state.migrations
    assert not cluster.state.start_orders.declared
    reply = cluster.apply("two", after(process("b"), "a"))
    assert "b -> a -> b is a circle" in reply.message


# --- circles of older journals ----------------------------------------------------------------


def with_circle() -> Cluster:
    """Return a cluster that has a circle of start orders, and a process behind it."""
    cluster = Cluster("h").with_processes(process("a"), process("b"), process("c"))
    cluster.submit(after(process("d"), "c"))
    for name, other in (("a", "b"), ("b", "a"), ("c", "a")):
        known = cluster[name]
        cluster.state.amend_spec(known, after(known.spec, other))
    return cluster


@pytest.mark.parametrize("restarts", [False, True])
def test_the_processes_of_a_circle_are_stopped_all_the_same(restarts: bool) -> None:
    """Each waits for the end of the other, until its time-out."""
    cluster = with_circle()
    if restarts:
        cluster.cancel("a", "b", "c", "d")
        cluster.restart_master()
    assert cluster.cancel("a", "b", "c", "d").accepted
    cluster.wait(100.0, tick=0.5)
    assert {cluster.phase(name) for name in "abcd"} == {"cancelled"}
    stopped = [one.instance.process for one in cluster.orders(StopInstance)]
    assert stopped[:2] == ["d", "c"]
    assert any("which did not end in time" in one for one in cluster.recorded("dependants_left"))


def test_those_outside_of_a_circle_keep_their_order() -> None:
    cluster = with_circle()
    known = [cluster[name] for name in "abcd"]
    assert [one.name for one in dependants_first(cluster.state, known)] == ["d", "c", "a", "b"]


def test_an_order_has_each_name_once() -> None:
    """Those in a circle, and those behind it, come last."""
    assert in_order({"a": ["b"], "b": ["c"], "c": ["b"], "d": []}) == ["d", "a", "b", "c"]
    assert in_order({}) == []


def test_no_other_module_walks_a_graph_that_may_raise() -> None:
    """`TopologicalSorter` raises `CycleError`, which would end each master that replays it."""
    root = Path(rosrm.__file__).parent
    users = [one for one in root.rglob("*.py") if "graphlib" in one.read_text()]
    assert [str(one.relative_to(root)) for one in users] == ["model/dependencies.py"]
