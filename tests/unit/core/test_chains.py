"""Chains of scoring policies: weighted sums, vetoes of each, parts in `explain`, failures."""

from __future__ import annotations

import numpy as np
import pytest

from rosrm.extensions.contracts import Scores
from rosrm.extensions.placement import ScoringLink
from tests.unit.core.cluster import Cluster, process


class ByName:
    """Scores by the name of the host; vetoes some hosts."""

    def __init__(self, scores, vetoed=()):
        self.scores, self.vetoed = scores, vetoed

    def score(self, hosts, process):
        return Scores(
            np.array([self.scores[name] for name in hosts.names]),
            np.array([name in self.vetoed for name in hosts.names]),
            veto_reason=lambda row: f"no place on {hosts.names[row]}",
            reason=lambda row: f"for {hosts.names[row]}",
        )


class Broken:
    def score(self, hosts, process):
        raise RuntimeError("out of order")


NEAR = ByName({"a": 1.0, "b": 2.0, "c": 3.0})
QUIET = ByName({"a": 5.0, "b": 1.0, "c": 0.0}, vetoed=("c",))


def chained(*links, **options):
    return Cluster("a", "b", "c", chain=links, **options)


def verdicts(cluster, name="p"):
    decision = cluster.explain(name)["decision"]
    return {one["name"]: one for one in decision["hosts"]}, decision["policy"]


@pytest.mark.parametrize(("weight", "host"), [(0.1, "a"), (1.0, "b")])
def test_the_weighted_sum_decides(weight, host):
    """The weight of a link decides which of two policies has its way."""
    cluster = chained(ScoringLink("near", NEAR), ScoringLink("quiet", QUIET, weight))
    cluster.submit(process("p"))
    assert cluster.where("p") == [host]


def test_each_part_of_a_score_is_explained():
    """`explain` names the policies, the score of each before its weight, and its own reason."""
    cluster = chained(ScoringLink("near", NEAR), ScoringLink("quiet", QUIET, 0.5))
    cluster.submit(process("p"))
    hosts, policy = verdicts(cluster)
    assert policy == "near + 0.5 x quiet"
    assert hosts["b"]["score"] == pytest.approx(2.5)
    assert hosts["b"]["reason"] == "near 2.000 (for b) + 0.5 x quiet 1.000 (for b)"


def test_a_veto_of_any_policy_holds_and_names_it():
    """A policy of weight 0 vetoes, too."""
    first = ByName({"a": 1.0, "b": 2.0, "c": 3.0}, vetoed=("a",))
    cluster = chained(ScoringLink("near", first), ScoringLink("quiet", QUIET, 0.0))
    cluster.submit(process("p"))
    hosts, _ = verdicts(cluster)
    assert cluster.where("p") == ["b"]
    assert (hosts["a"]["verdict"], hosts["a"]["reason"]) == ("vetoed", "near: no place on a")
    assert (hosts["c"]["verdict"], hosts["c"]["reason"]) == ("vetoed", "quiet: no place on c")


def test_the_sum_of_very_large_scores_is_finite():
    """An infinite sum would exclude the host."""
    large = ByName(dict.fromkeys("abc", 1e308))
    cluster = chained(ScoringLink("one", large), ScoringLink("other", large))
    cluster.submit(process("p"))
    assert cluster.where("p") == ["a"]


@pytest.mark.parametrize("at", [0, 1, 2])
def test_a_policy_that_fails_is_left_out_of_the_sum(at):
    """The others decide as if it were not there, and the decision names the failure."""
    links = [ScoringLink("near", NEAR), ScoringLink("quiet", QUIET)]
    links.insert(at, ScoringLink("broken", Broken(), 7.0))
    cluster = chained(*links, fallback=("spare", NEAR))
    cluster.submit(process("p"))
    hosts, policy = verdicts(cluster)
    assert cluster.where("p") == ["b"]
    assert hosts["b"]["score"] == pytest.approx(3.0)
    assert policy.startswith("near + quiet (left out: 'broken', RuntimeError: out of order")


def test_the_fallback_decides_only_if_every_policy_fails():
    """The fallback is no part of the sum."""
    cluster = chained(
        ScoringLink("one", Broken()), ScoringLink("two", Broken()), fallback=("spare", NEAR)
    )
    cluster.submit(process("p"))
    hosts, policy = verdicts(cluster)
    assert cluster.where("p") == ["a"]
    assert policy.startswith("spare (left out: 'one', ")
    assert "left out: 'two', " in policy
    assert hosts["a"]["reason"] == "for a"


@pytest.mark.filterwarnings("error")
def test_scores_that_are_huge_or_undefined_under_a_veto_leave_the_sum_finite():
    """Values of vetoed hosts may be anything, and no sum overflows."""
    odd = ByName({"a": np.nan, "b": 1e308, "c": -np.inf}, vetoed=("a", "c"))
    huge = ByName({"a": 0.0, "b": 1e308, "c": 0.0})
    cluster = chained(ScoringLink("odd", odd, 1e6), ScoringLink("huge", huge, 1e6))
    cluster.submit(process("p"))
    assert cluster.where("p") == ["b"]
    assert np.isfinite(verdicts(cluster)[0]["b"]["score"])


def test_a_chain_of_one_policy_with_a_weight_shows_the_weight():
    """The score in the table is the weighted one, so the reason names the factor."""
    cluster = chained(ScoringLink("near", NEAR, 2.0))
    cluster.submit(process("p"))
    hosts, policy = verdicts(cluster)
    assert (policy, hosts["a"]["score"]) == ("2 x near", pytest.approx(2.0))
    assert hosts["a"]["reason"] == "2 x near 1.000 (for a)"


class Odd:
    """A policy whose scores are fit for numpy alone: numbers as texts, or by name of the host."""

    def __init__(self, form):
        self.form = form

    def score(self, hosts, process):
        values = dict.fromkeys(hosts.names, "2")
        return Scores(self.form(values), reason=lambda _: "so")


class Named:
    """Numbers that are read as an array, and not by position."""

    def __init__(self, values):
        self.values = values

    def __array__(self, dtype=None, copy=None):
        return np.asarray(list(self.values.values()), dtype)

    def __getitem__(self, name):
        return self.values[name]


@pytest.mark.parametrize("form", [lambda values: list(values.values()), Named])
def test_scores_of_any_form_that_numpy_reads_are_explained(form):
    """A decision shows the checked numbers, and asks the plugin's own object for none."""
    cluster = chained(ScoringLink("odd", Odd(form)), ScoringLink("near", NEAR))
    cluster.submit(process("p"))
    hosts, _ = verdicts(cluster)
    assert hosts["a"]["reason"] == "odd 2.000 (so) + near 1.000 (for a)"
