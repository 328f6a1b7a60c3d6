"""Tenants of hosts, as scoring policies and filters see them."""

from __future__ import annotations

import pytest

from rosrm.extensions.contracts import Scores
from rosrm.extensions.declared_fields import declared_spec
from rosrm.extensions.placement import SelectedFilter
from tests.unit.core.cluster import Cluster, process


class Crowd:
    """Prefers the host on which the most processes of the same package run."""

    def __init__(self):
        self.seen = []

    def score(self, hosts, process):
        counts = self.counts(hosts, process)
        self.seen.append(dict(zip(hosts.names, hosts.tenants, strict=True)))
        return Scores(-counts, reason=lambda row: f"beside {sorted(hosts.tenants[row])}")

    def counts(self, hosts, process):
        import numpy as np

        program = process.spec.program
        return np.array(
            [sum(one.program == program for one in there.values()) for there in hosts.tenants],
            float,
        )


class AtMostOne:
    """Passes hosts without a process of the same program."""

    def mask(self, hosts, process):
        return Crowd().counts(hosts, process) < 1

    def reason(self, hosts, process, row):
        return f"it runs {', '.join(hosts.tenants[row])}"


def test_tenants_are_the_processes_with_an_instance_on_each_host():
    """Assigned, running and moving instances count at each host; ended ones do not."""
    policy = Crowd()
    cluster = Cluster("a", "b", policy=policy)
    cluster.submit(process("p"), process("q"))
    cluster.wait(1.0)
    cluster.cancel("p")
    cluster.wait(5.0)
    cluster.submit(process("r", command=("other",)))
    there = {name: set(tenants) for name, tenants in policy.seen[-1].items()}
    assert there == {"a": {"q"}, "b": set()}


class Even:
    """Prefers the host with the fewest processes."""

    calls = 0

    def score(self, hosts, process):
        self.calls += 1
        return Scores(hosts.processes.astype(float))


def test_only_a_policy_that_reads_tenants_is_called_after_each_assignment():
    """Without a reader one call scores a host for several equal processes ahead.

    Each decision is also scored once more for its record.
    """
    even, crowd = Even(), Crowd()
    for policy in (even, crowd):
        Cluster("a", policy=policy).submit(*(process(f"p{n}") for n in range(24)))
    assert len(crowd.seen) >= 2 * 24
    assert even.calls < 24 + 24 // 2


def test_tenants_and_specs_are_read_only():
    """A policy cannot change the master's state through a view."""
    policy = Crowd()
    cluster = Cluster("a", policy=policy)
    for name in ("p", "q"):
        cluster.submit(process(name, needs={"memory": 1.0}))
    (tenants,) = policy.seen[-1].values()
    with pytest.raises(TypeError):
        tenants["x"] = None
    for spec in (tenants["p"], declared_spec(cluster["q"].spec, ())):
        with pytest.raises(TypeError):
            spec.needs["memory"] = 2.0


@pytest.mark.parametrize("batched", [True, False])
def test_a_policy_counts_the_tenants_of_equal_processes_of_one_batch(*, batched):
    """Each decision sees the assignments before it, also those of equal processes."""
    cluster = Cluster("a", "b", "c", filters=[SelectedFilter("one", AtMostOne())])
    specs = [process(f"p{n}") for n in range(4)]
    for batch in [specs] if batched else [[one] for one in specs]:
        cluster.submit(*batch)
    placed = [cluster.where(f"p{n}") for n in range(4)]
    assert sorted(placed[:3]) == [["a"], ["b"], ["c"]]
    assert placed[3] == []
    assert cluster["p3"].phase.value == "queued"


def test_a_decision_is_explained_with_the_tenants_of_its_time():
    """A later assignment does not change the reasons of an earlier decision."""
    cluster = Cluster("a", "b", policy=Crowd())
    cluster.submit(process("p"))
    cluster.submit(process("q"))
    reasons = {
        name: [host["reason"] for host in cluster.explain(name)["decision"]["hosts"]]
        for name in ("p", "q")
    }
    assert reasons == {"p": ["beside []", "beside []"], "q": ["beside ['p']", "beside []"]}


def test_tenants_have_their_specs_after_a_restart_of_the_master():
    """Instances that the journal or a slave reports have the spec of their process."""
    policy = Crowd()
    cluster = Cluster("a", "b", policy=policy)
    cluster.submit(process("p", priority=7))
    cluster.wait(1.0)
    cluster.restart_master()
    cluster.wait(1.0)
    cluster.submit(process("q"))
    specs = {name: dict(tenants) for name, tenants in policy.seen[-1].items()}
    spec = specs["a"]["p"]
    assert (spec.name, spec.priority, spec.program) == ("p", 7, cluster["p"].spec.program)
