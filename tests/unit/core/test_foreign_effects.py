"""Effects of a process on the processes of other users: checked as a request for them would be."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from rosrm.core.master import events as happened
from rosrm.core.master.commands import Reply
from rosrm.model.requester import Requester
from rosrm.model.values import NeighbourRule, ProcessSpec, StartOrder
from tests.unit.core.cluster import MIB, Cluster, Machine, movable, process

ALICE, MALLORY = Requester("user:alice"), Requester("user:mallory")
ROOT = Requester("user:root", is_operator=True)


def submit(cluster: Cluster, by: Requester, *specs: ProcessSpec) -> Reply:
    reply = cluster.ask(happened.SubmissionReceived, specs, by)
    assert reply.accepted, reply.message
    return reply


def near(name: str) -> tuple[NeighbourRule, ...]:
    return (NeighbourRule("near", (name,)),)


def apart(name: str) -> tuple[NeighbourRule, ...]:
    return (NeighbourRule("apart", (name,)),)


def migrate(cluster: Cluster, name: str, by: Requester) -> Reply:
    return cluster.ask(happened.MigrationRequested, name, None, by)


def cluster_with_tie(declared_by: Requester) -> Cluster:
    """Return a cluster in which a process is tied to `own` of Alice."""
    cluster = Cluster("a", "b", cooldown=0.0)
    submit(cluster, ALICE, movable("own"))
    submit(cluster, declared_by, movable("tied", neighbours=near("own")))
    cluster.wait(2.0)
    assert cluster.where("own") == cluster.where("tied") == ["a"]
    return cluster


def test_a_move_takes_no_process_of_another_user_along() -> None:
    """The request is refused, as one to move that process would be."""
    cluster = cluster_with_tie(MALLORY)
    assert not migrate(cluster, "tied", MALLORY).accepted
    cluster.wait(5.0)
    assert cluster.where("own") == cluster.where("tied") == ["a"]
    assert not cluster.recorded("migrated")


def test_a_rule_of_another_user_binds_no_move() -> None:
    """The owner's process moves although the one that is tied to it cannot."""
    cluster = Cluster("a", "b", cooldown=0.0)
    submit(cluster, ALICE, movable("own"))
    submit(cluster, MALLORY, process("tied", neighbours=near("own")))
    cluster.wait(2.0)
    assert migrate(cluster, "own", ALICE).accepted
    cluster.wait(5.0)
    assert cluster.where("own") == ["b"]


def test_a_user_moves_no_process_of_an_operator() -> None:
    """A rule of an operator ties both; the move of one is a request for both."""
    cluster = cluster_with_tie(ROOT)
    reply = migrate(cluster, "own", ALICE)
    assert (reply.accepted, reply.code) == (False, "denied")
    assert "tied belongs to user:root" in reply.message


def test_a_rule_of_an_operator_moves_the_processes_of_users() -> None:
    """An operator may move every process, so its rule may."""
    cluster = cluster_with_tie(ROOT)
    assert migrate(cluster, "tied", ROOT).accepted
    cluster.wait(5.0)
    assert cluster.where("own") == cluster.where("tied") == ["b"]


def test_rights_of_rules_outlast_a_restart_of_the_master() -> None:
    """The journal has the role of the owner."""
    cluster = cluster_with_tie(ROOT)
    cluster.restart_master()
    cluster.wait(2.0)
    assert migrate(cluster, "tied", ROOT).accepted


@pytest.mark.parametrize("rules", [apart("own"), (NeighbourRule("apart", group="g"),)])
@pytest.mark.parametrize(("by", "starts"), [(MALLORY, True), (ALICE, False), (ROOT, False)])
def test_a_rule_apart_sets_no_process_of_another_user_aside(
    rules: tuple[NeighbourRule, ...], by: Requester, *, starts: bool
) -> None:
    """The process runs beside the one that wants to be apart from it."""
    cluster = Cluster("a")
    submit(cluster, by, process("alone", neighbours=rules))
    own = () if rules[0].processes else rules
    submit(cluster, ALICE, process("own", neighbours=own))
    cluster.wait(2.0)
    assert cluster.where("own") == (["a"] if starts else [])


@pytest.mark.parametrize(("by", "makes_room"), [(MALLORY, False), (ALICE, True), (ROOT, True)])
def test_a_priority_moves_no_process_of_another_user(by: Requester, *, makes_room: bool) -> None:
    """A process makes room for a higher priority of its own user, or of an operator."""
    cluster = Cluster(Machine("a", memory=1000 * MIB), preemption="requeue", settle=1.0)
    submit(cluster, ALICE, process("own", memory=300))
    cluster.wait(3.0)
    submit(cluster, by, process("high", memory=450, priority=9))
    cluster.wait(10.0)
    assert bool(cluster.recorded("preempted")) == makes_room


def dependant_of(cluster: Cluster, by: Requester) -> None:
    submit(cluster, ALICE, process("own"))
    submit(cluster, by, process("after", start_order=StartOrder(after={"own": "ready"})))
    cluster.wait(2.0)


@pytest.mark.parametrize(("by", "waits"), [(MALLORY, False), (ALICE, True), (ROOT, True)])
def test_a_dependant_of_another_user_delays_no_stop(by: Requester, *, waits: bool) -> None:
    """A cancelled process is stopped although the dependant of another user still runs."""
    cluster = Cluster("a")
    dependant_of(cluster, by)
    cluster.ask(happened.CancelRequested, ("after", "own"), ROOT, settle=False)
    assert bool(cluster.state.start_orders.last_to_stop) == waits


@pytest.mark.parametrize(("by", "blocks"), [(MALLORY, False), (ALICE, True), (ROOT, True)])
def test_a_dependant_of_another_user_blocks_no_prune(by: Requester, *, blocks: bool) -> None:
    """An ended process can be removed although a process of another user starts after it."""
    cluster = Cluster("a")
    dependant_of(cluster, by)
    cluster.ask(happened.CancelRequested, ("own",), ROOT)
    cluster.wait(2.0)
    assert cluster.ask(happened.PruneRequested, ("own",), (), ROOT).accepted != blocks


@pytest.mark.parametrize(("by", "refused"), [(MALLORY, False), (ALICE, True), (ROOT, True)])
def test_a_rule_of_another_user_refuses_no_submission(by: Requester, *, refused: bool) -> None:
    """Rules that contradict each other through a process of another user are accepted."""
    cluster = Cluster("a", "b")
    through = (*near("one"), *near("two"))
    submit(cluster, by, process("m", neighbours=through))
    specs = process("one"), process("two", neighbours=apart("one"))
    assert cluster.ask(happened.SubmissionReceived, specs, ALICE).accepted != refused


#: Specs of one user's process that name the process `own` of another one.
NAMING: dict[str, Callable[[], ProcessSpec]] = {
    "near": lambda: movable("m", neighbours=near("own")),
    "near a label": lambda: movable("m", neighbours=(NeighbourRule("near", ("own",), by="rack"),)),
    "apart": lambda: movable("m", neighbours=apart("own")),
    "talks": lambda: movable("m", talks_to={"own": 1e9}),
    "after": lambda: movable("m", start_order=StartOrder(after={"own": "ready"})),
    "priority": lambda: movable("m", priority=99),
}


@pytest.mark.parametrize("naming", NAMING)
def test_no_spec_changes_where_a_process_of_another_user_may_run(naming: str) -> None:
    """The hosts are judged as if the process that names the other one did not."""

    def judged(spec: ProcessSpec) -> object:
        cluster = Cluster(*(Machine(name, labels={"rack": name}) for name in "ab"))
        submit(cluster, ALICE, movable("own"))
        submit(cluster, MALLORY, spec)
        cluster.wait(2.0)
        cluster.ask(happened.CancelRequested, ("own",), ALICE)
        cluster.wait(2.0)
        cluster.ask(happened.RestartRequested, ("own",), ALICE)
        cluster.wait(2.0)
        return cluster.where("own"), cluster.explain("own")["decision"]["hosts"]

    at_a = {"rack": "a"} if naming.startswith("near") else {}  # where `own` starts
    assert judged(NAMING[naming]()) == judged(movable("m", required_labels=at_a))


@pytest.mark.parametrize("priority", [0, 99])
def test_a_process_that_waits_for_room_holds_back_none_of_another_user(priority: int) -> None:
    """The process may wait for ever. Only later processes of its owner wait behind it."""
    cluster = Cluster(Machine("a", memory=1000 * MIB))
    submit(cluster, ALICE, process("own", memory=300))
    cluster.wait(3.0)
    submit(cluster, MALLORY, process("large", memory=700, priority=priority))
    submit(cluster, MALLORY, process("later", memory=50))
    submit(cluster, ALICE, process("small", memory=50), process("first", memory=600))
    submit(cluster, ALICE, process("second", memory=50))
    cluster.wait(3.0)
    assert cluster.where("small") == ["a"]
    assert [cluster.phase(name) for name in ("large", "later", "second")] == ["queued"] * 3
    assert "large first" in cluster.explain("later")["reason"]
    assert "first first" in cluster.explain("second")["reason"]


def test_a_process_of_an_operator_holds_back_those_of_all() -> None:
    """Strict first in, first out: it gets its room before later ones take it."""
    cluster = Cluster(Machine("a", memory=1000 * MIB))
    submit(cluster, ALICE, process("own", memory=300))
    cluster.wait(3.0)
    submit(cluster, ROOT, process("large", memory=700))
    submit(cluster, ALICE, process("small", memory=50))
    cluster.wait(3.0)
    assert cluster.phase("small") == "queued"
    assert "large first" in cluster.explain("small")["reason"]
