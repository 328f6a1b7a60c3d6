"""`rosrm explain` of a host: over a limit, or being drained."""

from __future__ import annotations

import re
from typing import Any

import pytest

from rosrm.core.master.migration.host_explanation import host_explanation
from tests.unit.core.cluster import MIB, Cluster, process
from tests.unit.core.test_eviction import machine, on_a


def reasons(cluster: Cluster, name: str = "a") -> str:
    found = host_explanation(cluster.state, name, cluster.now)
    assert found is not None
    return "\n".join(found["reasons"])


def over(cluster: Cluster, seconds: float = 5.0) -> Cluster:
    """Let host a be over its limit of memory for some seconds."""
    cluster.machines["a"].busy["memory"] = 0.6
    cluster.wait(seconds)
    return cluster


@pytest.mark.parametrize(
    ("others", "settings", "seconds", "said"),
    [
        (
            [],
            {},
            5.0,
            "nothing can leave it: p and q: there is no other host. To lower.*add a host",
        ),
        (["b"], {"hysteresis": 60.0}, 5.0, r"p can move to b, after 60 s over the limit"),
        (["b"], {"automatic": False}, 5.0, "p can move to b, by `rosrm migrate`, because"),
    ],
)
def test_a_host_over_a_limit_tells_what_moves_or_why_nothing_does(
    others: list[str], settings: dict[str, Any], seconds: float, said: str
) -> None:
    """The sentence is shown while the host is over its limit; the event is recorded only once."""
    cluster = on_a({"p": 200, "q": 100}, *map(machine, others), **settings)
    assert reasons(cluster) == ""
    for _ in range(3):
        text = reasons(over(cluster, seconds))
        assert re.match(r"a is over its limit of memory \(\d+ % of at most 80 %, for ", text)
        assert re.search(said, text), text


def test_each_candidate_has_its_reason() -> None:
    cluster = on_a({"p": 200}, machine("b", memory=0.75))
    cluster.machines["a"].shown["q"] = {"memory": 100 * MIB}
    cluster.submit(process("q"))
    text = reasons(over(cluster))
    assert "it: p: no host has room for p; q has no migration strategy; give it" in text


def test_a_host_that_only_other_programs_fill_says_so() -> None:
    cluster = Cluster(machine("a", memory=0.9))
    cluster.wait(3.0)
    assert "no process of this cluster" in reasons(cluster)


def test_a_drain_names_those_that_stay_and_how_it_ends() -> None:
    cluster = on_a({"p": 200}, machine("b"))
    cluster.set_host("b", "cordon")
    cluster.submit(process("q"))
    cluster.set_host("b", "uncordon")
    cluster.set_host("a", "drain")
    cluster.wait(20.0)
    text = reasons(cluster)
    assert "a is drained: nothing can leave: q " in text
    assert "`rosrm cancel NAME` ends a process there, and `rosrm uncordon a` ends the drain" in text
    assert host_explanation(cluster.state, "no-such", cluster.now) is None
