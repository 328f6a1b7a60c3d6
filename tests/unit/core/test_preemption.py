"""Preemption: processes of lower priorities make room for one that fits on no host."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations
from typing import Any

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from rosrm.core.master import events as happened
from rosrm.core.master.migration.preemption import Group, covering_sets, rank
from rosrm.core.master.recovery import journal_gap
from rosrm.core.master.state.process import Process, ProcessPhase
from rosrm.extensions.contracts import HostView, ProcessView, Scores
from rosrm.model.values import NeighbourRule, ProcessSpec
from tests.unit.core.cluster import MIB, Cluster, Eq1, Machine, job, movable, process


def machine(name: str, memory: float = 1000, **known: Any) -> Machine:
    """Return a host of so many MiB, which may all be used."""
    limits = {"memory": 1.0, "cpu": 1.0}
    busy = {"memory": 0.0, "cpu": 0.0}
    return Machine(name, memory=memory * MIB, cpu=64.0, busy=busy, limits=limits, **known)


def cluster_of(*machines: Machine, **settings: Any) -> Cluster:
    known = {"hysteresis": 1.0, "cooldown": 10.0, "headroom": 0.0, "max_migrations": 8, **settings}
    return Cluster(*machines, **known)


def filled(cluster: Cluster, on: str, *specs: ProcessSpec) -> None:
    """Place processes on one host, in this order."""
    others = [name for name in cluster.machines if name != on]
    for other in others:
        cluster.set_host(other, "cordon")
    assert cluster.submit(*specs).accepted
    assert all(cluster.where(spec.name) == [on] for spec in specs)
    for other in others:
        cluster.set_host(other, "uncordon")


def two_hosts(**settings: Any) -> Cluster:
    """Return a large host that three processes fill, and a small one with room for two of them."""
    cluster = cluster_of(machine("a", 900), machine("b", 400), **settings)
    filled(cluster, "a", *(movable(name, memory=300 if name == "x" else 200) for name in "xyz"))
    return cluster


def test_the_smallest_set_of_lower_processes_moves_away() -> None:
    """One process of 300 MiB leaves, not two of 200 MiB; both sides are explained."""
    cluster = two_hosts()
    cluster.submit(process("p", memory=450, priority=5))
    assert cluster.phase("p") == "queued"
    cluster.wait(4.0)
    assert (cluster.where("p"), cluster.where("x"), cluster.where("y")) == (["a"], ["b"], ["a"])
    message = "x makes room on a for p, which has a higher priority (5 over 0): it moves to b"
    assert cluster.recorded("preempted") == [message, message]
    for name in ("p", "x"):
        assert message in [one["message"] for one in cluster.explain(name)["history"]]
    assert "it makes room for p, which has a higher priority (5 over 0)" in "".join(
        cluster.recorded("migration_begun")
    )


def test_of_equal_sets_the_one_with_the_lowest_priorities_moves() -> None:
    """Also if another one frees less."""
    cluster = cluster_of(machine("a", 600), machine("b", 286))
    filled(cluster, "a", movable("x", memory=285, priority=1), movable("y", memory=280))
    cluster.submit(process("p", memory=288, priority=5))
    cluster.wait(4.0)
    assert (cluster.where("p"), cluster.where("x"), cluster.where("y")) == (["a"], ["a"], ["b"])


@pytest.mark.parametrize("priority", [0, -1])
def test_no_process_makes_room_for_one_without_a_higher_priority(priority: int) -> None:
    """An equal priority is not higher."""
    cluster = two_hosts()
    cluster.submit(process("p", memory=450, priority=priority))
    cluster.wait(10.0)
    assert (cluster.phase("p"), cluster.recorded("preempted")) == ("queued", [])


def test_a_protected_process_never_makes_room() -> None:
    """The explanation names it."""
    cluster = cluster_of(machine("a", 600), machine("b", 400), preemption="requeue")
    filled(cluster, "a", movable("x", memory=400, protect=True))
    cluster.submit(process("p", memory=500, priority=5))
    cluster.wait(5.0)
    assert (cluster.phase("p"), cluster.where("x")) == ("queued", ["a"])
    assert cluster.explain("p")["reason"] == (
        "no host can take it now; no process of a lower priority can make room: x is protected"
    )


def test_without_preemption_the_process_waits() -> None:
    """`preemption: false`."""
    cluster = two_hosts(preemption=False)
    cluster.submit(process("p", memory=450, priority=5))
    cluster.wait(5.0)
    assert (cluster.phase("p"), cluster.recorded("preempted")) == ("queued", [])


def test_by_default_no_process_is_stopped_for_another() -> None:
    """A process without a migration strategy stays."""
    cluster = cluster_of(machine("a", 600), machine("b", 400))
    filled(cluster, "a", process("x", memory=400))
    cluster.submit(process("p", memory=500, priority=5))
    cluster.wait(5.0)
    assert (cluster.phase("p"), cluster.where("x")) == ("queued", ["a"])
    assert "x has no migration strategy" in cluster.explain("p")["reason"]


def test_with_requeue_a_process_that_cannot_move_waits_in_the_queue_again() -> None:
    """The process runs again as soon as there is room."""
    cluster = cluster_of(machine("a", 600), preemption="requeue")
    filled(cluster, "a", process("x", memory=400))
    cluster.submit(job("p", memory=500, priority=5))
    cluster.wait(4.0)
    assert (cluster.where("p"), cluster.phase("x")) == (["a"], "queued")
    assert cluster.recorded("preempted")[0] == (
        "x makes room on a for p, which has a higher priority (5 over 0): it waits in the queue "
        "again"
    )
    cluster.finish("p")
    cluster.wait(1.0)
    assert cluster.where("x") == ["a"]


def test_with_requeue_a_process_that_can_move_moves() -> None:
    """The queue is the last resort."""
    cluster = two_hosts(preemption="requeue")
    cluster.submit(process("p", memory=450, priority=5))
    cluster.wait(4.0)
    assert (cluster.where("p"), cluster.where("x")) == (["a"], ["b"])


def test_processes_that_cannot_all_move_do_not_begin_to() -> None:
    """Their moves are planned together: two of them fit elsewhere one by one only."""
    cluster = cluster_of(machine("a", 900), machine("b", 400))
    filled(cluster, "a", *(movable(name, memory=300) for name in "xyz"))
    cluster.submit(process("p", memory=600, priority=5))
    cluster.wait(5.0)
    assert (cluster.counts(), cluster.phase("p")) == ({"a": 3, "b": 0}, "queued")


def test_a_small_process_behind_does_not_take_the_room() -> None:
    """With backfill a requeued process could return to its host before the room is complete."""
    cluster = cluster_of(machine("a", 600), preemption="requeue", backfill=True)
    cluster.machines["a"].stubborn.add("y")
    filled(cluster, "a", process("x", memory=300), process("y", memory=300))
    cluster.submit(process("p", memory=600, priority=5))
    cluster.wait(3.0)
    assert (cluster.where("x"), cluster.phase("x"), cluster.where("y")) == ([], "queued", ["a"])
    decision = cluster.explain("x")["decision"]
    assert decision["hosts"][0]["reason"] == "room is being made there for a process of priority 5"
    cluster.let_go("y")
    cluster.wait(3.0)
    assert (cluster.where("p"), cluster.queue()) == (["a"], ["x", "y"])


def test_processes_on_one_host_by_rule_make_room_together() -> None:
    """A tie to a process of an equal priority keeps both."""
    near = (NeighbourRule("near", ("x",)),)
    cluster = cluster_of(machine("a", 600), machine("b", 600))
    filled(cluster, "a", movable("x", memory=200), movable("y", memory=200, neighbours=near))
    filled(cluster, "b", process("z", memory=100, protect=True))
    cluster.submit(process("p", memory=550, priority=5))
    cluster.wait(4.0)
    assert (cluster.where("p"), cluster.where("x"), cluster.where("y")) == (["a"], ["b"], ["b"])


def test_a_move_that_is_under_way_counts_as_room() -> None:
    """No further process makes room, also after a restart of the master."""
    cluster = two_hosts()
    cluster.machines["a"].stubborn.add("x")
    cluster.submit(process("p", memory=450, priority=5))
    cluster.wait(2.5)
    cluster.restart_master()
    cluster.wait(5.0)
    assert len(cluster.recorded("preempted")) == 2
    cluster.let_go("x")
    cluster.wait(1.0)
    assert cluster.where("p") == ["a"]


def test_moves_beyond_the_bound_follow_one_after_the_other() -> None:
    """`max_migrations` holds for preemption too."""
    cluster = cluster_of(machine("a", 700), machine("b", 600), max_migrations=1)
    filled(cluster, "a", *(movable(name, memory=200) for name in "xyz"))
    cluster.submit(process("p", memory=650, priority=5))
    cluster.machines["a"].stubborn.update("xyz")
    for moved in (1, 2, 3):
        cluster.wait(5.0)
        (name,) = cluster.state.migrations
        assert cluster.counts()["b"] == moved
        cluster.let_go(name)
    cluster.wait(3.0)
    assert (cluster.where("p"), cluster.counts()["b"]) == (["a"], 3)


def test_a_slot_counts_as_room() -> None:
    """A host that may run one process takes one of a higher priority."""
    cluster = cluster_of(machine("a", max_processes=1), machine("b"))
    filled(cluster, "a", movable("x", memory=10))
    cluster.set_host("b", "cordon")
    cluster.submit(process("p", memory=10, priority=5))
    cluster.wait(3.0)
    assert cluster.where("p") == []
    cluster.set_host("b", "uncordon")
    cluster.wait(1.0)
    assert cluster.where("p") == ["b"]


def test_a_process_is_not_moved_again_within_its_cool_down() -> None:
    """Otherwise two urgent processes could send it back and forth."""
    cluster = cluster_of(machine("a", 600), machine("b", 500), cooldown=10.0)
    filled(cluster, "a", movable("x", memory=400))
    cluster.submit(process("p", memory=550, priority=5))
    cluster.wait(4.0)
    assert (cluster.where("p"), cluster.where("x")) == (["a"], ["b"])
    cluster.submit(process("q", memory=450, priority=6))
    cluster.add(machine("c", 400))
    cluster.wait(5.0)
    assert (cluster.phase("q"), cluster.where("x")) == ("queued", ["b"])
    assert "x is in its cool-down of 10 s after a move" in cluster.explain("q")["reason"]
    cluster.wait(8.0)
    assert (cluster.where("q"), cluster.where("x")) == (["b"], ["c"])


class NotOnA(Eq1):
    """Policy with a veto against host a, which it gives also when there is room."""

    def score(self, hosts: HostView, process: ProcessView) -> Scores:
        found = super().score(hosts, process)
        veto = np.array([name == "a" for name in hosts.names]) & (process.spec.priority > 0)
        return Scores(found.value, veto=veto, veto_reason=lambda row: "not on a")


def test_no_room_is_made_on_a_host_that_a_policy_excludes() -> None:
    """A trial with the free room shows the veto, before any process leaves."""
    cluster = cluster_of(machine("a", 600), machine("b", 400), policy=NotOnA(), cooldown=3.0)
    filled(cluster, "a", movable("x", memory=350))
    cluster.submit(process("p", memory=500, priority=5))
    cluster.wait(60.0, tick=0.5)
    assert (cluster.where("x"), cluster.recorded("preempted")) == (["a"], [])
    assert "there would still be no room" in cluster.explain("p")["reason"]


# --- claims -----------------------------------------------------------------------------------


def claimed(**settings: Any) -> Cluster:
    """Return a cluster in which room is made on a for p, and x does not leave."""
    cluster = two_hosts(**settings)
    cluster.machines["a"].stubborn.add("x")
    cluster.submit(process("p", memory=450, priority=5))
    cluster.wait(3.0)
    assert cluster.state.hosts.claims == {0: 5}
    return cluster


def let_go_and_place(cluster: Cluster) -> None:
    """End the move of x; p then runs in its place."""
    cluster.let_go("x")
    cluster.wait(1.5)
    assert (cluster.where("p"), cluster.state.hosts.claims) == (["a"], {})


def test_a_claim_stands_while_other_moves_use_the_bound() -> None:
    """The next move of the set waits for its turn."""
    cluster = cluster_of(machine("a", 700), machine("b", 650), machine("c", 100), max_migrations=1)
    filled(cluster, "a", *(movable(name, memory=200) for name in "xyz"))
    filled(cluster, "b", movable("q", memory=50, protect=True))
    cluster.submit(process("p", memory=650, priority=5))
    cluster.machines["a"].stubborn.update("xyz")
    cluster.machines["b"].stubborn.add("q")
    cluster.wait(5.0)
    (first,) = cluster.state.migrations
    cluster.let_go(first)
    assert cluster.migrate("q", "c").accepted
    for _ in range(10):
        cluster.wait(1.0)
        assert (list(cluster.state.migrations), cluster.state.hosts.claims) == (["q"], {0: 5})
    reason = "no process can make room yet: other moves are under way (`migration.max_in_flight`)"
    assert reason in cluster.explain("p")["reason"]
    cluster.let_go("q", on="b")
    for _ in range(2):
        cluster.wait(5.0)
        (name,) = cluster.state.migrations
        cluster.let_go(name)
    cluster.wait(3.0)
    assert cluster.where("p") == ["a"]


@pytest.mark.parametrize("backfill", [False, True])
def test_a_claim_stands_while_processes_of_a_higher_priority_wait_before_it(backfill: bool) -> None:
    """However many they are."""
    cluster = claimed(backfill=backfill)
    higher = [process(f"h{i}", memory=850, priority=9) for i in range(6)]
    cluster.submit(*higher)
    cluster.wait(3.0)
    assert cluster.state.hosts.claims == {0: 5}
    assert "x leaves a to make room" in cluster.explain("p")["reason"]
    cluster.cancel(*(one.name for one in higher))
    let_go_and_place(cluster)


def test_a_claim_stands_while_the_master_assigns_no_work() -> None:
    """The master waits for all hosts, because its journal has lost records."""
    cluster = claimed(lease=60.0)
    journal_gap.begin(cluster.state, 0, cluster.now, machine_rebooted=False)
    cluster.cut("b", seconds=2.0)
    cluster.machines["b"].restart_slave(cluster.now)
    cluster.machines["b"].connected = True
    assert cluster.register(cluster.machines["b"], journal_seen=10).accepted
    cluster.wait(5.0)
    assert "the journal has lost its newest records" in cluster["p"].reason
    assert cluster.state.hosts.claims == {0: 5}
    cluster.wait(60.0, tick=1.0)
    let_go_and_place(cluster)


def test_a_claim_stands_while_its_host_is_silent_for_a_moment() -> None:
    """Its processes leave later, and the process that waited is placed there."""
    cluster = claimed()
    cluster.cut("a", seconds=4.0)
    cluster.reconnect("a", seconds=2.0)
    assert cluster.state.hosts.claims == {0: 5}
    let_go_and_place(cluster)


def test_a_claim_ends_if_processes_do_not_leave_in_time() -> None:
    """The explanation names them, and the host is not claimed again for the process."""
    cluster = cluster_of(machine("a", 600), preemption="requeue")
    filled(cluster, "a", process("x", memory=400))
    cluster.machines["a"].stubborn.add("x")
    cluster.submit(job("p", memory=500, priority=5))
    cluster.wait(100.0, tick=0.5)
    assert cluster.state.hosts.claims == {0: 5}
    cluster.wait(30.0, tick=0.5)
    assert cluster.state.hosts.claims == {}
    assert "x did not leave a in time to make room" in cluster.explain("p")["reason"]
    cluster.wait(60.0, tick=0.5)
    assert cluster.state.hosts.claims == {}
    cluster.cancel("p")
    cluster.submit(job("p", memory=550, priority=5))  # another process, for which it is tried again
    cluster.wait(2.5)
    assert cluster.state.hosts.claims == {0: 5}
    let_go_and_place(cluster)


def test_two_processes_of_one_priority_do_not_count_on_the_same_room() -> None:
    """The second one waits for the room of the first one, and then gets its own."""
    cluster = cluster_of(machine("a", 800), preemption="requeue", backfill=True)
    filled(cluster, "a", process("x", memory=390), process("y", memory=390))
    cluster.machines["a"].stubborn.update("xy")
    cluster.submit(*(process(name, memory=400, priority=5) for name in "pq"))
    cluster.wait(10.0)
    for name in "xy":
        assert cluster.phase(name) == "stopping"
        cluster.let_go(name)
        cluster.wait(10.0)
    assert (cluster.where("p"), cluster.where("q")) == (["a"], ["a"])


# --- properties -------------------------------------------------------------------------------


def group(name: str, priority: int, *share: float, members: int = 1) -> Group:
    """Return processes that leave together, and free the share."""
    processes = tuple(
        Process(process(f"{name}{i}", priority=priority), 1, ProcessPhase.RUNNING, 0.0)
        for i in range(members)
    )
    return Group((), processes, np.array([*share, members]))


amounts = st.sampled_from([0.0, 0.1, 0.2, 0.3, 0.5])
groups = st.lists(
    st.tuples(st.integers(0, 3), amounts, amounts, st.sampled_from([1, 1, 1, 2])), max_size=6
).map(
    lambda drawn: [
        group(f"p{i}", priority, memory, cpu, members=members)
        for i, (priority, memory, cpu, members) in enumerate(drawn)
    ]
)
missing = st.tuples(amounts, amounts, st.sampled_from([-1.0, 0.0, 1.0, 2.0])).map(np.array)


@given(groups, missing)
def test_the_first_set_is_the_smallest_one_and_of_these_that_with_the_lowest_priorities(
    drawn: list[Group], lacks: np.ndarray
) -> None:
    """By comparison with all sets."""
    assume((lacks > 0).any())
    every = [
        chosen
        for size in range(1, len(drawn) + 1)
        for chosen in combinations(drawn, size)
        if (sum(one.share for one in chosen) >= lacks - 1e-9).all()
    ]
    found = list(covering_sets(drawn, lacks))
    assert bool(found) == bool(every)
    if every:
        best = min(map(rank, every))
        assert rank(found[0])[:2] == best[:2]
        assert [rank(one) for one in found] == sorted(rank(one) for one in found)


specs = st.lists(
    st.builds(
        lambda memory, priority, moves, protect: (memory, priority, moves, protect),
        st.sampled_from([100, 200, 300, 500]), st.integers(0, 3), st.booleans(),
        st.sampled_from([False, False, True]),
    ),
    min_size=3, max_size=8,
)  # fmt: skip


@settings(max_examples=20, deadline=None)
@given(specs, st.sampled_from(["move", "requeue"]), st.booleans(), st.integers(1, 3))
def test_preemption_touches_only_lower_processes_without_protection_and_comes_to_an_end(
    drawn: list[tuple[int, int, bool, bool]], mode: str, backfill: bool, most: int
) -> None:
    """No process is sent back and forth, and none of a higher priority waits for nothing."""
    cluster = cluster_of(
        machine("a", 600), machine("b", 500), preemption=mode, backfill=backfill,
        max_migrations=most, cooldown=2.0,
    )  # fmt: skip
    for i, (memory, priority, moves, protect) in enumerate(drawn):
        make = movable if moves else process
        cluster.submit(make(f"p{i}", memory=memory, priority=priority, protect=protect))
        cluster.wait(1.5, tick=0.5)
    cluster.wait(30.0, tick=0.5)
    before = len(cluster.records)
    cluster.wait(15.0, tick=0.5)
    assert cluster.records[before:] == []
    for one in cluster.records:
        if one.kind == "preempted":
            preemptor, other = one.facts["for"], one.process
            if other != preemptor:
                assert cluster[other].spec.priority < cluster[preemptor].spec.priority
                assert not cluster[other].spec.protect
    # Each process makes room at most once for each one of a higher priority.
    pairs = [
        (one.process, one.facts["for"]) for one in cluster.records
        if one.kind == "preempted" and one.process != one.facts["for"]
    ]  # fmt: skip
    assert len(pairs) == len(set(pairs))


def test_many_processes_that_cannot_move_do_not_hide_one_that_can() -> None:
    """A process without a destination is tried once, not in every set."""
    cluster = cluster_of(machine("a", 2000), machine("b", 75))
    many = [movable(f"p{i:02}", memory=80) for i in range(24)]
    filled(cluster, "a", *many, movable("q", memory=70, priority=1))
    cluster.submit(process("r", memory=78, priority=5))
    cluster.wait(5.0)
    assert (cluster.where("r"), cluster.where("q")) == (["a"], ["b"])


def test_a_claim_ends_with_the_setting() -> None:
    """A reload may switch preemption off while room is made."""
    cluster = two_hosts()
    cluster.machines["a"].stubborn.add("x")
    cluster.submit(process("p", memory=450, priority=5))
    cluster.wait(3.0)
    assert cluster.state.hosts.claims == {0: 5}
    cluster.state.settings = replace(cluster.state.settings, preemption=False)
    cluster.wait(1.5)
    assert cluster.state.hosts.claims == {}


def test_no_process_makes_room_before_a_host_that_registers_now_has_asked_for_work() -> None:
    """As after each restart of the master; the placement waits for that host, too."""
    cluster = cluster_of(machine("a"), preemption="requeue")
    cluster.submit(process("low", memory=800))
    cluster.submit(process("p", memory=500, priority=5))
    cluster.now += 1.5
    late = cluster.machines["b"] = machine("b")
    late.incarnation = 9
    assert cluster.enter(late, 0, ()).accepted
    cluster.read(cluster.machines["a"])
    cluster.tell(happened.TimePassed())
    assert cluster.phase("low") == "running"
    cluster.wait(3.0)
    assert (cluster.where("p"), cluster.phase("low")) == (["b"], "running")
