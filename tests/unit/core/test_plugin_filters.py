"""Filters of plugins: they hold for every placement, are explained, and fail closed."""

from __future__ import annotations

import numpy as np
import pytest

from rosrm.extensions.placement import SelectedFilter
from rosrm.model.values import MigrationPolicy
from tests.unit.core.cluster import Cluster, Machine, process


class Named:
    """Passes the hosts of some names."""

    def __init__(self, *names):
        self.names = names

    def mask(self, hosts, process):
        return np.array([name in self.names for name in hosts.names], np.bool_)

    def reason(self, hosts, process, row):
        return f"it is called {hosts.names[row]}"


class Answers(Named):
    """Answers with the outcome of a function of the hosts."""

    def __init__(self, make):
        self.make = make

    def mask(self, hosts, process):
        return self.make(hosts)


def filtered(*filters, **options):
    return Cluster("a", "b", "c", filters=filters, **options)


def verdicts(cluster, name="p"):
    hosts = cluster.explain(name)["decision"]["hosts"]
    return {one["name"]: (one["verdict"], one["reason"]) for one in hosts}


def test_only_hosts_that_pass_every_filter_are_chosen():
    """Each excluded host has the reason and the name of its first filter."""
    cluster = filtered(
        SelectedFilter("late", Named("b", "c")), SelectedFilter("early", Named("a", "b"))
    )
    cluster.submit(process("p"))
    assert cluster.where("p") == ["b"]
    assert verdicts(cluster)["a"] == ("excluded", "it is called a (filter late)")
    assert verdicts(cluster)["c"] == ("excluded", "it is called c (filter early)")


def test_the_rules_of_the_core_come_first():
    """A cordoned host has the core's reason, not that of a filter."""
    cluster = filtered(SelectedFilter("named", Named("b")))
    cluster.set_host("a", "cordon")
    cluster.submit(process("p"))
    assert verdicts(cluster)["a"] == ("excluded", "it is cordoned")


def test_a_filter_holds_for_the_destination_of_a_move():
    """A drained process goes to a host that passes, or stays."""
    cluster = filtered(SelectedFilter("named", Named("a", "c")))
    cluster.submit(process("p", migration=MigrationPolicy("relaunch")))
    assert cluster.where("p") == ["a"]
    cluster.set_host("a", "drain")
    cluster.wait(10.0)
    assert cluster.where("p") == ["c"]


@pytest.mark.parametrize("permanent", [True, False])
def test_a_drain_ends_if_no_other_host_passes_for_good(permanent):
    """The process stays; with a filter that is not permanent it waits for a destination."""
    cluster = filtered(SelectedFilter("named", Named("a"), permanent=permanent))
    cluster.submit(process("p", migration=MigrationPolicy("relaunch")))
    cluster.wait(1.0)
    cluster.set_host("a", "drain")
    cluster.wait(5.0)
    assert cluster.where("p") == ["a"]
    assert cluster.state.hosts.by_name["a"].drained is permanent


@pytest.mark.parametrize(("permanent", "phase"), [(True, "set_aside"), (False, "queued")])
def test_a_process_that_every_host_fails_for_good_is_set_aside(permanent, phase):
    """A permanent filter does not block the queue; another one waits for a change."""
    cluster = filtered(SelectedFilter("named", Named(), permanent=permanent))
    cluster.submit(process("p"))
    assert cluster["p"].phase.value == phase
    if permanent:
        assert "a is called a (filter named)" in cluster["p"].reason


@pytest.mark.parametrize(
    ("answer", "said"),
    [
        (lambda hosts: 1 / 0, "ZeroDivisionError"),
        (lambda hosts: None, "answered None; booleans are required"),
        (lambda hosts: [1] * len(hosts.names), "a mask of type int64; booleans are required"),
        (lambda hosts: np.ones(1, np.bool_), "a mask of shape (1,) for 3 hosts"),
        (lambda hosts: hosts.usage.__setitem__(0, 1.0), "read-only"),
    ],
)
@pytest.mark.parametrize("permanent", [True, False])
def test_a_filter_that_fails_passes_no_host(answer, said, permanent):
    """The process waits with the reason, and is not set aside, until the filter works again."""
    broken = Answers(answer)
    cluster = filtered(SelectedFilter("broken", broken, permanent=permanent))
    cluster.submit(process("p"))
    assert (cluster.where("p"), cluster["p"].phase.value) == ([], "queued")
    verdict, reason = verdicts(cluster)["a"]
    assert verdict == "excluded"
    assert reason.startswith("the filter broken failed: ")
    assert said in reason
    assert ("filter", "broken") in cluster.state.plugins.failing

    broken.make = lambda hosts: np.ones(len(hosts.names), np.bool_)
    cluster.wait(1.0)
    assert cluster.where("p") == ["a"]


def test_a_filter_reads_the_fields_that_it_declares():
    """A field that only another plugin declares counts as undeclared."""

    class ByName(Named):
        def mask(self, hosts, process):
            return np.array([name == process.spec.name[0] for name in hosts.names])

    cluster = filtered(SelectedFilter("by_name", ByName(), reads=("name",)))
    cluster.submit(process("b1"), process("c1"), process("b2"))
    assert [cluster.where(name) for name in ("b1", "c1", "b2")] == [["b"], ["c"], ["b"]]

    cluster = filtered(SelectedFilter("by_name", ByName()), reads=("name",))
    cluster.submit(process("b1"))
    assert "add reads=('name',) to the offer" in verdicts(cluster, "b1")["b"][1]


def test_masks_of_labels_are_those_of_the_registration():
    """`labelled` is a new array each time, for all hosts and for some."""
    seen = []

    class Red(Named):
        def mask(self, hosts, process):
            mask = hosts.labelled("color", "red")
            assert mask.tolist() == [one.get("color") == "red" for one in hosts.labels]
            seen.append(mask.copy())
            mask[:] = ~mask
            return ~mask

    machines = [Machine("a"), Machine("b", labels={"color": "red"}), Machine("c", labels={})]
    cluster = Cluster(*machines, filters=[SelectedFilter("red", Red())])
    cluster.submit(process("p"), process("q"))
    assert (cluster.where("p"), cluster.where("q")) == (["b"], ["b"])
    assert {len(mask) for mask in seen} > {3}
