"""Gangs that can never start are refused, and no process is stopped for one that waits."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from rosrm.core.master.migration.preemption import preempt
from rosrm.model.arrays import ArrayMembership
from rosrm.model.values import NeighbourRule, ProcessSpec, StartOrder
from tests.unit.core.cluster import Cluster, job, movable, node, process
from tests.unit.core.test_gangs import machine, preempted


def member(name: str, *after: str, together: str = "g", **fields: Any) -> ProcessSpec:
    order = StartOrder(dict.fromkeys(after, "ready"))
    return process(name, start_order=order, together=together, **fields)


def jobs(parallel: int) -> list[ProcessSpec]:
    return [
        job(f"j{at}", together="g", array=ArrayMembership("j", at, parallel)) for at in range(3)
    ]


IN_ORDER = "but the gang g starts at once, so it never starts"
REFUSED = {
    "one after another": (
        [member("a"), member("b", "a")],
        f"b: after: b starts after a, {IN_ORDER}: remove one of the orders, or `together` of one",
    ),
    "through a third process": (
        [member("a"), member("b", "c"), member("c", "a", together="")],
        f"b: after: b starts after c and c starts after a, {IN_ORDER}",
    ),
    "two gangs": (
        [member("a"), member("b", "d"), member("c", "a", together="h"), member("d", together="h")],
        "b: after: b starts after d and c starts after a, but each of the gangs g and h starts at",
    ),
    "an array": (
        jobs(2),
        "j0: together: 3 jobs of the array j are in the gang g and start at once, but `parallel` l",
    ),
}  # fmt: skip


@pytest.mark.parametrize(("specs", "says"), REFUSED.values(), ids=REFUSED)
@pytest.mark.parametrize("applied", [False, True])
def test_a_gang_that_can_never_start_is_refused(
    specs: list[ProcessSpec], says: str, applied: bool
) -> None:
    """The master refuses it as the loader of files does."""
    cluster = Cluster("h")
    reply = cluster.apply("app", *specs) if applied else cluster.submit(*specs)
    assert not reply.accepted
    assert reply.message.startswith(says)
    assert not cluster.state.processes


def test_a_version_whose_gang_could_never_start_does_not_return() -> None:
    """Another application starts after a process of the gang since, and the gang after its own."""
    cluster = Cluster("h")
    cluster.apply("two", process("c"))
    cluster.apply("one", member("a"), member("b", "c"))
    cluster.wait(3.0)
    alone = member("a", together="")
    assert cluster.apply("one", alone, process("x"), healthy_for=30.0).accepted
    cluster.wait(1.0)
    assert cluster.apply("two", member("c", "a", together="", command=("new",))).accepted
    cluster.wait(3.0)
    for name in ("a", "x"):
        cluster.finish(name, "h", code=1)
    cluster.wait(3.0)
    (said,) = cluster.recorded("application_failed")
    assert "one is paused: " in said
    assert "the former version 1 does not return: b: after: b starts after c and c st" in said
    assert cluster.recorded("application_returns") == []


def test_a_version_whose_gang_waits_for_a_failed_process_does_not_return() -> None:
    """No member of the gang could start, and the running processes would be stopped for it."""
    cluster = Cluster("h").with_processes(process("c"))
    cluster.apply("one", member("a"), member("b", "c"))
    cluster.wait(3.0)
    new = member("a", together="", command=("new",))
    assert cluster.apply("one", new, process("x"), healthy_for=30.0).accepted
    cluster.wait(3.0)
    cluster.finish("c", "h", code=1)
    cluster.finish("x", "h", code=1)
    cluster.wait(3.0)
    (said,) = cluster.recorded("application_failed")
    assert "the former version 1 does not return: b: after: c has failed: `rosrm re" in said
    assert cluster.phase("a") == "running"


def test_a_process_that_the_former_version_lacks_does_not_prevent_the_return() -> None:
    """In the failed version d waits, through x, for a process outside its gang."""
    cluster = Cluster("h")
    cluster.apply("one", member("a"), member("b"))
    cluster.wait(3.0)
    other = replace(node("x"), start_order=StartOrder({"a": "ready"}))
    assert cluster.apply("one", member("a", together=""), other, member("d", "x")).accepted
    cluster.wait(1.0)
    assert cluster.phase("d") == "queued"
    for name in ("a", "x"):
        cluster.finish(name, "h", code=1)
    cluster.wait(3.0)
    assert {cluster.phase(name) for name in "ab"} == {"running"}


def test_a_process_that_joins_its_gang_later_counts() -> None:
    """Its application starts it once its former instance has ended."""
    cluster = Cluster("h")
    file = [member("a"), member("b", "c")]
    cluster.apply("two", node("c"))
    cluster.discover("c", "h")
    cluster.apply("one", *file)
    cluster.submit(member("d", "a", together=""))
    cluster.restart("c")
    cluster.machines["h"].stubborn.add("a")
    cluster.cancel("a", "b")
    assert cluster.apply("one", *file).accepted
    said = cluster.apply("two", replace(node("c"), start_order=StartOrder({"d": "ready"})))
    assert said.message.startswith(
        "c: after: c starts after d, d starts after a and b starts after c, "
    )


def test_what_can_start_is_accepted() -> None:
    """A gang after a process or after another gang, and an array with enough places."""
    cluster = Cluster("h").with_processes(
        process("c"), member("a", "c"), member("b", "c"), member("d", "a", together="h"),
        member("e", together="h"),
    )  # fmt: skip
    assert {cluster.phase(name) for name in "abcde"} == {"running"}
    assert cluster.submit(*jobs(3)).accepted
    assert cluster.phase("j2") == "running"


def test_a_process_after_a_started_one_of_its_gang_is_accepted() -> None:
    """Processes that have started have left the gang."""
    cluster = Cluster("h").with_processes(member("a"))
    assert cluster.submit(member("b", "a")).accepted
    assert cluster.phase("b") == "running"


@pytest.mark.parametrize("own", [False, True])
def test_a_change_that_closes_the_order_of_a_waiting_gang_is_refused(own: bool) -> None:
    """The gang waits for `c`, which would wait for a process of the gang then."""
    cluster, gang = Cluster(), [member("a"), member("b", "c")]
    cluster.apply("app", process("c"), *(gang if own else ()))
    assert own or cluster.submit(*gang).accepted
    reply = cluster.apply("app", member("c", "a", together=""), *(gang if own else ()))
    assert not reply.accepted
    assert "c starts after a" in reply.message
    assert IN_ORDER in reply.message


def test_a_smaller_array_of_a_waiting_gang_is_refused() -> None:
    """The number of jobs at a time changes in place."""
    cluster = Cluster()
    assert cluster.apply("app", *jobs(3)).accepted
    reply = cluster.apply("app", *jobs(1))
    assert not reply.accepted
    assert "`parallel` lets 1 job run at a time" in reply.message


def test_a_restart_that_joins_a_waiting_gang_is_refused() -> None:
    """`b` waits for `a`, which would wait for it as well."""
    cluster = Cluster("h").with_processes(member("a"))
    cluster.set_host("h", "cordon")
    cluster.submit(member("b", "a"))
    cluster.finish("a", "h", code=1)
    cluster.wait(1.0)
    reply = cluster.restart("a")
    assert not reply.accepted
    assert f"b starts after a, {IN_ORDER}" in reply.message


# --- preemption -------------------------------------------------------------------------------


def waiting_for_room(second: ProcessSpec, **settings: Any) -> Cluster:
    """Return a cluster with a gang that fits only if `x` and `y` move from `a` to `b`."""
    known = {"preemption": "move", "headroom": 0.0, "hysteresis": 0.5, "settle": 1.0, **settings}
    cluster = Cluster(machine("a"), machine("b"), **known)
    cluster.set_host("b", "cordon")
    cluster.submit(movable("x", memory=300), movable("y", memory=300))
    cluster.set_host("b", "uncordon")
    cluster.set_host("a", "cordon")
    cluster.submit(process("kept", memory=100, protect=True), process("c", memory=10))
    cluster.submit(job("hold"), process("late", start_order=StartOrder({"hold": "finished"})))
    cluster.set_host("a", "uncordon")
    cluster.submit(member("first", memory=700, priority=5), second)
    assert cluster.phase("first") == "queued"
    return cluster


WAITS = {
    "another process": member("second", "late", priority=5),
    "a neighbour": member("second", neighbours=(NeighbourRule("near", ("late",)),), priority=5),
}


@pytest.mark.parametrize("second", WAITS.values(), ids=WAITS)
def test_no_process_makes_room_for_a_gang_that_waits_for_something_else(
    second: ProcessSpec,
) -> None:
    """One of its processes could not start then, so none of them could."""
    cluster = waiting_for_room(second)
    cluster.wait(5.0)
    assert (preempted(cluster, "x"), preempted(cluster, "y")) == (0, 0)
    cluster.finish("hold", "b")
    cluster.wait(20.0)
    assert cluster.phase("first") == cluster.phase("second") == "running"
    assert (preempted(cluster, "x"), preempted(cluster, "y")) == (1, 1)


def test_no_process_makes_room_for_a_gang_of_which_one_is_not_in_the_queue() -> None:
    """An assignment of it is still being withdrawn."""
    cluster = waiting_for_room(member("second", priority=5), hysteresis=1e6)
    cluster.state.unqueue(cluster["second"])
    cluster.state.settings = replace(cluster.state.settings, hysteresis=0.5)
    cluster.now += 5.0
    preempt(cluster.state, cluster.now)
    assert preempted(cluster, "x") == 0


def test_a_claim_stops_no_further_process_while_its_gang_waits() -> None:
    """The claim stays until its deadline, because the wait may be short."""
    cluster = waiting_for_room(member("second", "c", priority=5), max_migrations=1)
    while not preempted(cluster, "x") + preempted(cluster, "y"):
        cluster.wait(0.5)
    cluster.finish("c", "b", code=1)
    cluster.wait(5.0)
    assert preempted(cluster, "x") + preempted(cluster, "y") == 1
    claim = cluster.state.preemption.room_made["first"]
    assert claim.host is cluster.state.hosts.by_name["a"]
    cluster.restart("c")
    cluster.wait(20.0)
    assert cluster.phase("first") == cluster.phase("second") == "running"
