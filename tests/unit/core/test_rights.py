"""Owners of processes: their rights in each request, and after restarts of the master."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rosrm.core.master import events as happened
from rosrm.core.master import listing
from rosrm.core.master.commands import Reply
from rosrm.model.requester import Requester
from rosrm.model.values import ProcessSpec
from tests.unit.core.cluster import Cluster, job, movable, process

ADA, BOB = Requester("user:ada"), Requester("user:bob")
ROOT = Requester("user:root", is_operator=True)
UNKNOWN = Requester()

#: Each request on processes, with the names of two processes (the first one, if it takes one).
ACTIONS: dict[str, Callable[[Cluster, tuple[str, ...], Requester], Reply]] = {
    "cancel": lambda cluster, names, by: cluster.ask(happened.CancelRequested, names, by),
    "restart": lambda cluster, names, by: cluster.ask(happened.RestartRequested, names, by),
    "migrate": lambda cluster, names, by: cluster.ask(
        happened.MigrationRequested, names[-1], None, by
    ),
    "checkpoint": lambda cluster, names, by: cluster.ask(
        happened.CheckpointRequested, names[-1], by
    ),
    "restore": lambda cluster, names, by: cluster.ask(happened.RestoreRequested, names[-1], by),
    "prune": lambda cluster, names, by: cluster.ask(happened.PruneRequested, names, (), by),
    "submit": lambda cluster, names, by: submit(cluster, by, *map(process, names)),
}


def submit(cluster: Cluster, by: Requester, *specs: ProcessSpec) -> Reply:
    return cluster.ask(happened.SubmissionReceived, specs, by)


def two_owners() -> Cluster:
    """Return a cluster in which Ada runs `own` and Bob `other`, and `old` has no known owner."""
    cluster = Cluster("a", "b")
    assert submit(cluster, ADA, movable("own")).accepted
    assert submit(cluster, BOB, movable("other")).accepted
    assert submit(cluster, UNKNOWN, movable("old")).accepted
    return cluster


@pytest.mark.parametrize("action", ACTIONS)
@pytest.mark.parametrize("named", ["other", "old"])
def test_a_process_of_another_owner_is_not_touched(action: str, named: str) -> None:
    """The request is refused as a whole, and neither journal nor hosts change."""
    cluster = two_owners()
    before = len(cluster.carried)
    intents = {table: dict(rows) for table, rows in cluster.intents.items()}
    reply = ACTIONS[action](cluster, ("own", named), ADA)
    assert (reply.accepted, reply.code) == (False, "denied")
    owner = "user:bob" if named == "other" else "an unknown owner"
    assert reply.message == (
        f"{named} belongs to {owner}; user:ada may act only on its own processes: ask the owner or "
        f"an operator. Nothing was changed"
    )
    assert cluster.carried[before:] == [reply]
    assert cluster.intents == intents


@pytest.mark.parametrize("action", ACTIONS)
@pytest.mark.parametrize(("named", "by"), [("own", ADA), ("own", ROOT), ("old", ROOT)])
def test_owner_and_operator_are_not_denied(action: str, named: str, by: Requester) -> None:
    """Some requests fail for other reasons, such as the state of the process."""
    assert ACTIONS[action](two_owners(), (named,), by).code != "denied"


@pytest.mark.parametrize("action", ACTIONS)
def test_a_requester_without_a_name_owns_nothing(action: str) -> None:
    """A process without a known owner is not its own."""
    assert ACTIONS[action](two_owners(), ("old",), UNKNOWN).code == "denied"


def test_several_owners_are_named_together() -> None:
    """Each owner is named with its processes."""
    cluster = two_owners()
    reply = cluster.ask(happened.CancelRequested, ("old", "own", "other"), ADA)
    assert reply.message.startswith("old belongs to an unknown owner; other belongs to user:bob;")


def test_an_unknown_name_is_reported_before_an_owner() -> None:
    """A misspelt name is the likelier mistake."""
    assert two_owners().ask(happened.CancelRequested, ("other", "otter"), ADA).code == "unknown"


def test_the_name_of_an_ended_process_stays_with_its_owner() -> None:
    """Owner and operator may submit it again; then it belongs to the sender."""
    cluster = Cluster("a")
    submit(cluster, BOB, job("p"))
    cluster.finish("p")
    assert submit(cluster, ADA, job("q"), job("p")).code == "denied"
    assert "q" not in cluster.state.processes
    assert submit(cluster, BOB, job("p")).accepted
    cluster.finish("p")
    assert submit(cluster, ROOT, job("p")).accepted
    assert cluster["p"].principal == "user:root"


def test_a_restart_by_an_operator_keeps_the_owner() -> None:
    """The owner is the user that submitted the process."""
    cluster = Cluster("a")
    submit(cluster, ADA, job("p"))
    cluster.finish("p")
    assert cluster.ask(happened.RestartRequested, ("p",), ROOT).accepted
    assert cluster["p"].principal == "user:ada"


def test_prune_without_names_leaves_the_processes_of_others() -> None:
    """The request names nothing, so nothing is denied."""
    cluster = Cluster("a")
    submit(cluster, ADA, job("p"))
    submit(cluster, BOB, job("q"))
    cluster.finish("p")
    cluster.finish("q")
    assert cluster.ask(happened.PruneRequested, (), (), ADA).message == "1 process removed"
    assert set(cluster.state.processes) == {"q"}


def test_the_owner_is_in_the_row_the_explanation_and_each_record() -> None:
    """Records of a process without a known owner have none."""
    cluster = two_owners()
    cluster.ask(happened.RestartRequested, ("own",), ROOT)
    owners = {row.name: row.owner for row in listing.process_rows(cluster.state, cluster.now)}
    assert owners == {"own": "user:ada", "other": "user:bob", "old": ""}
    assert [cluster.explain(name)["owner"] for name in owners] == list(owners.values())
    about = [record for record in cluster.records if record.process]
    assert {(one.process, one.facts.get("owner", "")) for one in about} == set(owners.items())
    restart = next(one for one in about if one.kind == "restart_requested")
    assert (restart.facts["owner"], restart.facts["by"]) == ("user:ada", "user:root")


def test_owners_survive_a_restart_of_the_master() -> None:
    """The journal stores them."""
    cluster = two_owners()
    cluster.kill_master()
    assert {one.name: one.principal for one in cluster.state.processes.values()} == {
        "own": "user:ada", "other": "user:bob", "old": "",
    }  # fmt: skip
    assert cluster.ask(happened.CancelRequested, ("other",), ADA).code == "denied"
    assert cluster.ask(happened.CancelRequested, ("own",), ADA).accepted


def test_a_journal_without_owners_is_restored() -> None:
    """Only operators may act on its processes."""
    cluster = two_owners()
    for row in cluster.intents["process"].values():
        del row["principal"]
    cluster.kill_master()
    assert {one.principal for one in cluster.state.processes.values()} == {""}
    assert cluster.ask(happened.CancelRequested, ("own",), ADA).code == "denied"
    assert cluster.ask(happened.CancelRequested, ("own",), ROOT).accepted


STEPS = st.lists(
    st.tuples(
        st.sampled_from([ADA, BOB, UNKNOWN]),
        st.sampled_from(["cancel", "restart", "migrate", "prune", "submit", "end", "crash"]),
        st.lists(st.sampled_from("pqr"), min_size=1, max_size=2, unique=True).map(tuple),
    ),
    max_size=25,
)


@settings(deadline=None, max_examples=100)
@given(steps=STEPS)
def test_no_request_changes_a_process_of_another_owner(steps: Any) -> None:
    """Whatever users do and in whichever order, each process that changes is the sender's own."""
    cluster = Cluster("a", "b")
    for by, action, names in steps:
        if action == "crash":
            cluster.kill_master()
            for host in "ab":
                cluster.rejoin(host)
            continue
        if action == "end":
            for name in filter(cluster.where, names):
                cluster.finish(name, on=cluster.where(name)[0])
            continue
        processes = cluster.state.processes
        others = {one.name for one in processes.values() if one.principal != by.name}
        before = {name: (cluster[name], cluster[name].phase) for name in others}
        reply = ACTIONS[action](cluster, names, by)
        assert (reply.code == "denied") <= (not reply.accepted)
        if by.name and others.intersection(names):
            assert not reply.accepted
        for name, (one, phase) in before.items():
            assert processes.get(name) is one
            assert by.name == "" or one.phase is phase
