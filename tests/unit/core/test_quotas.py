"""Quotas of users: a submission beyond one is refused as a whole."""

from __future__ import annotations

import math
from collections.abc import Mapping

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rosrm.core.master import events as happened
from rosrm.core.master.commands import Reply
from rosrm.model.requester import Requester
from rosrm.model.values import ProcessSpec
from tests.unit.core.cluster import MIB, Cluster, job, process

ADA, BOB = Requester("user:ada"), Requester("user:bob")
ROOT = Requester("user:root", is_operator=True)

Quotas = Mapping[str, Mapping[str, float]]


def submit(cluster: Cluster, by: Requester, *specs: ProcessSpec) -> Reply:
    return cluster.ask(happened.SubmissionReceived, specs, by)


def jobs(number: int, first: int = 0, **fields: float) -> list[ProcessSpec]:
    return [job(f"j{at}", **fields) for at in range(first, first + number)]


@pytest.mark.parametrize(
    ("quotas", "by", "allowed"),
    [
        ({}, ADA, 9),
        ({"default": {"processes": 2}}, ADA, 2),
        ({"default": {"processes": 2}}, Requester(), 2),
        ({"default": {"processes": 2}}, ROOT, 9),
        ({"default": {"processes": 2}, "user:ada": {"processes": 4}}, ADA, 4),
        ({"default": {"processes": 2}, "user:ada": {"processes": 4}}, BOB, 2),
        ({"default": {"processes": 2}, "user:ada": {"memory": 1e12}}, ADA, 2),
        ({"user:ada": {"processes": 0}}, ADA, 0),
        ({"user:ada": {"processes": 4}}, BOB, 9),
        ({"default": {"processes": 2}, "user:root": {"processes": 3}}, ROOT, 3),
        ({"default": {"processes": 2}, "user:root": {"memory": 1e12}}, ROOT, 9),
    ],
)
def test_the_quota_of_a_user(quotas: Quotas, by: Requester, allowed: int) -> None:
    """A limit of the user's own entry, else of the default; for operators, only of their own."""
    cluster = Cluster("a", quotas=quotas)
    accepted = sum(submit(cluster, by, one).accepted for one in jobs(9))
    assert accepted == allowed


def test_a_submission_beyond_a_quota_is_refused_as_a_whole() -> None:
    """The message has the user, the limit, the amount in use and the requested amount."""
    cluster = Cluster("a", quotas={"default": {"processes": 3, "memory": 1e9, "cpu": 2.5}})
    two = [process(f"p{at}", needs={"memory": 400e6, "cpu": 1.0}) for at in range(2)]
    assert submit(cluster, ADA, *two).accepted
    before = dict(cluster.intents["process"])
    more = [process(f"q{at}", needs={"memory": 150e6, "cpu": 0.5}) for at in range(2)]
    reply = submit(cluster, ADA, *more)
    assert (reply.accepted, reply.code) == (False, "quota")
    assert reply.message == (
        "user:ada would exceed its quota of processes: 2 in use, 2 more requested, 3 allowed; "
        "memory: 800 MB in use, 300 MB more requested, 1.0 GB allowed; "
        "cpu: 2 cores in use, 1 cores more requested, 2.5 cores allowed. Cancel processes, or ask "
        "an operator for a larger quota (`quotas` in cluster.yaml). Nothing was queued"
    )
    assert cluster.intents["process"] == before
    assert submit(cluster, ADA, more[0]).accepted
    assert submit(cluster, BOB, more[1]).accepted


def test_a_process_that_has_not_ended_counts() -> None:
    """Waiting or running; once it has ended, its share is free again."""
    cluster = Cluster("a", quotas={"default": {"processes": 2}})
    assert submit(cluster, ADA, job("runs"), job("waits", required_labels={"arm": "yes"})).accepted
    assert (cluster.phase("runs"), cluster.phase("waits")) == ("running", "set_aside")
    assert submit(cluster, ADA, job("third")).code == "quota"
    cluster.finish("runs")
    assert submit(cluster, ADA, job("third")).accepted
    cluster.cancel("waits")
    assert submit(cluster, ADA, job("waits")).accepted


def test_a_restart_of_an_ended_process_counts_like_a_submission() -> None:
    """Otherwise ended processes would be a way around the quota; operators may restart them."""
    cluster = Cluster("a", quotas={"default": {"processes": 1}})
    submit(cluster, ADA, job("p"))
    assert cluster.ask(happened.RestartRequested, ("p",), ADA).accepted
    cluster.finish("p")
    submit(cluster, ADA, job("q"))
    assert cluster.ask(happened.RestartRequested, ("p",), ADA).code == "quota"
    assert cluster.phase("p") == "finished"
    assert cluster.ask(happened.RestartRequested, ("p",), ROOT).accepted


def test_needs_are_declared_or_learned_or_the_default() -> None:
    """The same estimate as for the placement, at the time of the submission."""
    cluster = Cluster(
        "a", quotas={"default": {"memory": 300 * MIB}}, default_needs={"memory": 100 * MIB}
    )
    assert submit(cluster, ADA, *jobs(3)).accepted
    assert submit(cluster, ADA, process("p", memory=1)).code == "quota"
    cluster.state.learned.learn("run it", {"memory": 50 * MIB})
    assert submit(cluster, ADA, *jobs(3, first=3)).accepted
    assert submit(cluster, ADA, *jobs(1, first=6)).code == "quota"


def test_the_journal_is_restored_beyond_a_quota() -> None:
    """A smaller quota refuses only new processes."""
    cluster = Cluster("a", quotas={"default": {"processes": 5}})
    submit(cluster, ADA, *jobs(5))
    object.__setattr__(cluster.settings, "quotas", {"default": {"processes": 1}})
    cluster.kill_master()
    cluster.rejoin("a")
    assert len(cluster.state.processes) == 5
    assert submit(cluster, ADA, job("more")).code == "quota"


def test_needs_that_add_up_to_the_limit_are_within_it() -> None:
    """A rounding error of the sum refuses nothing."""
    cluster = Cluster("a", quotas={"default": {"cpu": 32.0}})
    assert submit(cluster, ADA, *[job(f"p{at}", needs={"cpu": 0.1}) for at in range(320)]).accepted
    assert submit(cluster, ADA, job("more", needs={"cpu": 0.1})).code == "quota"


@pytest.mark.parametrize("cpu", [math.nan, math.inf, 1e308])
def test_needs_that_are_no_amount_are_beyond_every_quota(cpu: float) -> None:
    """The network layer refuses them, and so does the core."""
    cluster = Cluster("a", quotas={"default": {"cpu": 32.0}})
    assert submit(cluster, ADA, *[job(name, needs={"cpu": cpu}) for name in "pq"]).code == "quota"


@given(
    sizes=st.lists(
        st.tuples(st.sampled_from([ADA, BOB, ROOT]), st.integers(1, 4), st.integers(0, 3)),
        max_size=12,
    )
)
def test_no_user_has_more_than_its_quota(sizes: list[tuple[Requester, int, int]]) -> None:
    """After any submissions and ends."""
    limits = {"user:ada": 5, "user:bob": 3}
    cluster = Cluster("a", quotas={name: {"processes": most} for name, most in limits.items()})
    for at, (by, number, ended) in enumerate(sizes):
        submit(cluster, by, *(job(f"j{at}.{one}") for one in range(number)))
        runs = [name for name, one in cluster.state.processes.items() if one.owner]
        for name in runs[:ended]:
            cluster.finish(name)
        for name, most in limits.items():
            own = [one for one in cluster.state.processes.values() if one.principal == name]
            assert sum(not one.phase.is_terminal for one in own) <= most
