"""Neighbours on real slaves: placement, a move together, and a contradiction."""

from __future__ import annotations

import pytest

from rosrm.config.settings import MigrationSettings, ProcessDefaults
from rosrm.errors import Refused
from rosrm.model.values import MigrationPolicy, NeighbourRule
from tests.ros.clusters import MIB, STEADY, host, service

MOVES = MigrationPolicy("relaunch")


def test_neighbours_are_placed_and_moved_by_their_rules(make_cluster) -> None:
    """A viewer follows its camera through a drain, and both stay apart from a planner."""
    cluster = make_cluster(
        host("a", labels={"rack": "1"}), host("b", labels={"rack": "1"}),
        host("c", labels={"rack": "2"}), liveness=STEADY,
        migration=MigrationSettings(automatic=False),
        defaults=ProcessDefaults(needs={"memory": MIB}),
    )  # fmt: skip
    near, apart = (
        NeighbourRule("near", ("camera",)),
        NeighbourRule("apart", ("planner",), by="rack"),
    )
    cluster.submit(service("viewer", migration=MOVES, neighbours=(near,)))
    cluster.wait_for_event("waits", "camera, near which the process must run, does not exist")
    camera = service("camera", migration=MOVES, neighbours=(apart,), required_labels={"rack": "1"})
    cluster.submit(camera)
    first = cluster.wait("viewer", "running").host
    assert cluster.wait("camera", "running").host == first

    cluster.submit(service("planner"))
    assert cluster.wait("planner", "running").host == "c"

    other = service("other", neighbours=(near, NeighbourRule("apart", ("camera",))))
    with pytest.raises(Refused, match="other and camera must run apart, and near each other"):
        cluster.submit(other)

    cluster.client.set_host_state(first, "drain")
    there = {"a": "b", "b": "a"}[first]
    for name in ("camera", "viewer"):
        assert cluster.wait(name, "running", migrations=1).host == there
    assert cluster.events("separated") == []
