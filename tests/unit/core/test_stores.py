"""Bounds of what one user stores in the master: specs of processes and versions."""

from __future__ import annotations

import pytest

from rosrm.core.master import events as happened
from rosrm.core.master.commands import Reply
from rosrm.core.master.invariants import check
from rosrm.model.ledger import BOUNDS, Amount, Store
from rosrm.model.requester import Requester
from rosrm.model.values import ProcessSpec
from tests.unit.core.cluster import Cluster, job, process

ALICE, MALLORY = Requester("user:alice"), Requester("user:mallory")
ROOT = Requester("user:root", is_operator=True)
KIB = 1 << 10


@pytest.fixture(autouse=True)
def small_bounds(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(BOUNDS, Store.SPECS, (Amount(50, 100 * KIB), Amount(500, 1000 * KIB)))  # type: ignore[misc]


def large(name: str, size: int = 10 * KIB) -> ProcessSpec:
    return job(name, environment={"X": "x" * size})


def submit(cluster: Cluster, by: Requester, *specs: ProcessSpec) -> Reply:
    return cluster.ask(happened.SubmissionReceived, specs, by)


def test_large_specs_of_one_user_are_bounded_together() -> None:
    """A further large spec is refused; another user, and an operator, may still submit."""
    cluster = Cluster("a")
    accepted = [submit(cluster, MALLORY, large(f"m{n}")).accepted for n in range(300)]
    assert sum(accepted) == 9
    assert accepted == sorted(accepted, reverse=True)
    assert submit(cluster, ALICE, large("alice")).accepted
    assert submit(cluster, ROOT, *(large(f"root{n}") for n in range(20))).accepted
    refused = submit(cluster, MALLORY, large("again"))
    assert refused.code == "quota"
    assert "user:mallory would have 10 specs" in refused.message
    assert submit(cluster, MALLORY, process("small")).accepted


def test_ended_processes_give_way_to_new_ones_of_their_user() -> None:
    """A user may submit any number one after the other; the oldest are forgotten."""
    cluster = Cluster("a")
    assert submit(cluster, ALICE, large("alice")).accepted
    cluster.finish("alice")
    for number in range(40):
        assert submit(cluster, MALLORY, large(f"m{number}")).accepted
        cluster.finish(f"m{number}")
    own = [name for name in cluster.state.processes if name.startswith("m")]
    assert own == [f"m{number}" for number in range(31, 40)]
    assert "alice" in cluster.state.processes
    check(cluster.state)


def test_versions_of_applications_are_bounded_by_owner() -> None:
    """Applying and cancelling other applications, or versions, keeps no more than the bound."""
    cluster = Cluster("a")
    for number in range(40):
        reply = cluster.apply(f"app{number}", large(f"m{number}"), by=MALLORY)
        assert reply.accepted, reply.message
        cluster.apply(f"app{number}", by=MALLORY)
        cluster.wait(1.0)
    assert cluster.state.ledger.of(MALLORY.name).size <= 100 * KIB
    assert len(cluster.state.applications) < 12
    reply = cluster.apply("large", *(large(f"x{n}") for n in range(6)), by=MALLORY)
    assert (reply.accepted, reply.code) == (False, "quota")
    check(cluster.state)


def test_a_plan_forgets_nothing() -> None:
    """Only a request that is carried out removes ended processes."""
    cluster = Cluster("a")
    for number in range(8):
        assert submit(cluster, MALLORY, large(f"m{number}")).accepted
        cluster.finish(f"m{number}")
    before = list(cluster.state.processes)
    assert cluster.apply("app", large("x", 30 * KIB), by=MALLORY, plan=True).accepted
    assert list(cluster.state.processes) == before


def test_the_store_of_a_user_outlasts_a_restart_of_the_master() -> None:
    """The journal has the specs, whose sizes count again."""
    cluster = Cluster("a")
    for number in range(9):
        assert submit(cluster, MALLORY, large(f"m{number}")).accepted
    cluster.apply("app", process("small"), by=ALICE)
    cluster.restart_master()
    assert not submit(cluster, MALLORY, large("again")).accepted
    check(cluster.state)


def test_one_user_leaves_places_for_others() -> None:
    """A user has at most 80 % of `queue.max_processes`, an operator all."""
    cluster = Cluster("a", max_processes=10)
    assert not submit(cluster, MALLORY, *(process(f"m{n}") for n in range(9))).accepted
    assert submit(cluster, MALLORY, *(process(f"m{n}") for n in range(8))).accepted
    refused = submit(cluster, MALLORY, process("more"))
    assert (refused.accepted, refused.code) == (False, "quota")
    assert submit(cluster, ALICE, process("own")).accepted
    assert submit(cluster, ROOT, process("root")).accepted


def test_a_request_for_very_many_processes_is_refused_at_once() -> None:
    """All targets of a request count together."""
    cluster = Cluster("a", max_processes=10)
    reply = cluster.apply("app", *(process(f"m{n}") for n in range(11)), by=MALLORY)
    assert not reply.accepted
    assert reply.message.startswith("11 processes are requested at once")
