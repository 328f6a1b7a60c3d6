"""Moves of lifecycle nodes by the strategy `lifecycle_node`: at most one node is active."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import pytest

from rosrm.core.master.commands import Command
from rosrm.model.plan import SetLifecycle
from rosrm.model.values import InstanceState, LifecyclePolicy, MigrationPolicy, RestartPolicy
from rosrm_migration.lifecycle_node import LifecycleNode, LifecycleNodeOptions
from tests.unit.core.cluster import Cluster, Machine, node

SETTLE = LifecycleNodeOptions().settle


@pytest.fixture
def cluster() -> Cluster:
    """Return a cluster where p is active on a, and b has room; every step is checked."""
    strategies = {"lifecycle_node": LifecycleNode(LifecycleNodeOptions())}
    cluster = Cluster("a", Machine("b", busy={"memory": 0.5, "cpu": 0.1}), strategies=strategies)

    def check(_commands: Sequence[Command]) -> None:
        assert len(active(cluster)) <= 1, active(cluster)

    cluster.watch = check
    cluster.submit(
        node(
            "p", migration=MigrationPolicy("lifecycle_node"), lifecycle=LifecyclePolicy("active"),
            restart=RestartPolicy("on-failure"),
        )
    )  # fmt: skip
    cluster.discover("p")
    assert (cluster.phase("p"), active(cluster)) == ("running", ["p#1 on a"])
    return cluster


def active(cluster: Cluster) -> list[str]:
    """Return the instances whose nodes are active."""
    return [
        f"{instance} on {machine.name}"
        for machine in cluster.machines.values()
        for instance, program in machine.programs.items()
        if program.lifecycle_state == "active"
    ]


def at(cluster: Cluster, state: str) -> Any:
    """Return the current step of the move, which must set this state."""
    step = cluster.state.migrations["p"].current_step
    assert isinstance(step, SetLifecycle)
    assert step.state == state
    return step


def test_the_destination_is_active_after_the_source(cluster) -> None:
    """The new node is configured beside the active source, which ends after the commit."""
    cluster.migrate("p")
    cluster.discover("p", "b")
    assert (active(cluster), cluster.where("p")) == (["p#1 on a"], ["a", "b"])
    cluster.wait(2 * SETTLE)
    (there,) = active(cluster)
    assert there.endswith("on b")
    assert (cluster.phase("p"), cluster.where("p")) == ("running", ["b"])


def test_a_move_goes_on_after_a_restart_of_the_master(cluster) -> None:
    """The source is inactive for as long as the destination does not answer."""
    cluster.migrate("p")
    cluster.discover("p", "b")
    cluster.machines["b"].connected = False
    cluster.wait(2 * SETTLE)
    assert active(cluster) == []
    at(cluster, "active")
    cluster.machines["b"].connected = True
    cluster.restart_master()
    cluster.wait(2 * SETTLE)
    assert [one[-1] for one in active(cluster)] == ["b"]


def test_a_destination_that_ends_gives_the_activity_back(cluster) -> None:
    """The source was inactive, and is active again; it was not restarted."""
    cluster.migrate("p")
    cluster.discover("p", "b")
    cluster.machines["b"].connected = False
    cluster.wait(2 * SETTLE)
    at(cluster, "active")
    there = cluster.machines["b"].find("p")
    cluster.machines["b"]._end(there, InstanceState.FAILED, cluster.now, code=1)
    cluster.machines["b"].connected = True
    cluster.wait(2 * SETTLE)
    assert active(cluster) == ["p#1 on a"]
    assert (cluster.phase("p"), cluster.where("p")) == ("running", ["a"])
