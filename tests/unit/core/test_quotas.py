"""Quotas of users: a submission beyond one is refused as a whole."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rosrm.core.master import events as happened
from rosrm.core.master.assignment.gang_search import MOST_MEMBERS
from rosrm.core.master.commands import Reply
from rosrm.core.master.state.process import ProcessPhase
from rosrm.model.applications import RolloutPolicy, Target
from rosrm.model.modes import Mode
from rosrm.model.requester import Requester
from rosrm.model.values import ProcessSpec, RestartPolicy
from tests.unit.core.cluster import GIB, MIB, Cluster, Machine, job, node, process
from tests.unit.core.test_applications import row

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


# --- the resulting whole ----------------------------------------------------------------------

MEMORY: Quotas = {"default": {"memory": 4 * GIB}}


def target(name: str, *specs: ProcessSpec) -> Target:
    parts = tuple(replace(spec, application=name) for spec in specs)
    return Target(name, parts, 0, RolloutPolicy(healthy_for=1.0))


def applied(cluster: Cluster, *targets: Target, plan: bool = False) -> Reply:
    return cluster.ask(happened.ApplicationsRequested, targets, plan, ADA)


@pytest.mark.parametrize("plan", [False, True])
@pytest.mark.parametrize("command", [("run", "it"), ("new",)])
def test_a_new_version_beyond_a_quota_is_refused(plan: bool, command: tuple[str, ...]) -> None:
    """The same holds for a change in place and for a new start."""
    cluster = Cluster("a", quotas=MEMORY)
    assert applied(cluster, target("nav", process("p", 1024))).accepted
    cluster.wait(2.0)
    large = target("nav", process("p", 5 * 1024, command=command))
    assert applied(cluster, large, plan=plan).code == "quota"
    small = target("nav", process("p", 3 * 1024, command=command))
    assert applied(cluster, small, plan=plan).accepted


@pytest.mark.parametrize("plan", [False, True])
def test_all_applications_of_a_request_count_together(plan: bool) -> None:
    """Each of them alone would be within the quota."""
    cluster = Cluster("a", quotas={"default": {"processes": 2}})
    targets = [target(name, job(f"{name}1"), job(f"{name}2")) for name in "xyz"]
    assert applied(cluster, *targets, plan=plan).code == "quota"
    assert applied(cluster, targets[0], plan=plan).accepted


def test_a_mode_beyond_a_quota_is_not_put_into_force() -> None:
    """Its applications count together, too."""
    cluster = Cluster("a", quotas={"user:ada": {"processes": 2}})
    cluster.ask(happened.ModesLoaded, (Mode("m", (target("x", job("p"), job("q")),)),))
    assert applied(cluster, target("x", job("p"))).accepted
    assert submit(cluster, ADA, job("single")).accepted
    assert cluster.ask(happened.ModeRequested, "m").code == "quota"


def test_a_process_that_its_application_has_yet_to_start_counts() -> None:
    """The process waits until a former instance of its name has ended."""
    cluster = Cluster(Machine("a", stubborn={"p"}), quotas={"default": {"processes": 1}})
    assert applied(cluster, target("nav", process("p"))).accepted
    cluster.wait(1.0)
    cluster.state.set_phase(cluster["p"], ProcessPhase.FAILED, cluster.now)
    cluster["p"].owner = 0
    assert applied(cluster, target("nav", process("p"))).accepted
    assert row(cluster).pending
    assert submit(cluster, ADA, job("more")).code == "quota"


def test_the_version_to_which_a_failure_leads_back_counts() -> None:
    """Otherwise its return would exceed the quota, and nothing could refuse it."""
    cluster = Cluster("a", quotas=MEMORY)
    applied(cluster, target("nav", process("p", 3 * 1024)))
    cluster.wait(2.0)
    applied(cluster, target("nav", process("p", 1024, command=("new",)), node("q")))
    cluster.wait(2.0)
    assert cluster["p"].spec.command == ("new",)
    assert submit(cluster, ADA, job("more", 2 * 1024)).code == "quota"
    cluster.discover("q")
    cluster.wait(3.0)
    assert submit(cluster, ADA, job("more", 2 * 1024)).accepted


def test_a_request_that_raises_nothing_is_not_refused() -> None:
    """The same holds where the quota is exceeded already, because an operator has lowered it."""
    cluster = Cluster("a", quotas=MEMORY)
    applied(cluster, target("nav", process("p", 3 * 1024), process("q", 512)))
    cluster.wait(2.0)
    object.__setattr__(cluster.settings, "quotas", {"default": {"memory": 1 * GIB}})
    assert applied(cluster, target("nav", process("p", 2 * 1024))).accepted
    cluster.wait(2.0)
    assert applied(cluster, target("nav", process("p", 2.5 * 1024))).code == "quota"


@pytest.mark.parametrize("again", ["restart", "apply"])
def test_ended_processes_that_start_again_count_for_the_limit_of_the_cluster(again: str) -> None:
    """Ended processes count as submitted ones do."""
    cluster = Cluster("a", max_processes=2)
    cluster.apply("nav", process("p", restart=RestartPolicy("never")))
    cluster.wait(1.0)
    cluster.finish("p", code=1)
    cluster.wait(1.0)
    cluster.submit(job("q"), job("r"))
    reply = cluster.restart("p") if again == "restart" else cluster.apply("nav", process("p"))
    assert not reply.accepted
    assert "queue.max_processes" in reply.message


def test_a_gang_is_bounded_as_a_whole() -> None:
    """A restart, several applications and a change in place are bounded, too."""
    many = [job(f"j{at}", together="g") for at in range(MOST_MEMBERS + 1)]
    cluster = Cluster("a")
    half = len(many) // 2
    two = target("x", *many[:half]), target("y", *many[half:])
    assert "at most" in applied(cluster, *two).message
    singles = [job(one.name, 100 * 1024) for one in many]
    assert applied(cluster, target("x", *singles)).accepted
    assert "at most" in applied(cluster, target("x", *many)).message
    cluster = Cluster("a")
    for part in (many[:half], many[half:]):
        assert submit(cluster, ADA, *part).accepted
        for one in part:
            cluster.finish(one.name)
    restart = cluster.ask(happened.RestartRequested, tuple(one.name for one in many), ADA)
    assert "at most" in restart.message
