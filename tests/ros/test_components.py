"""Components that a real slave loads into a real container."""

from __future__ import annotations

import os
import signal
from pathlib import Path

import pytest

from rosrm.model.values import Component, MigrationPolicy, ProcessSpec, RestartPolicy
from tests.ros.clusters import Cluster, host

pytest.importorskip("composition_interfaces")

ROOT = Path(__file__).resolve().parents[2]
TALKER = "tests.ros.programs.components:Talker"
BROKEN = "tests.ros.programs.components:Broken"


@pytest.fixture(scope="module")
def cluster(make_shared) -> Cluster:
    return make_shared(host("a"), host("b"))


def container(name: str, *components: Component, **fields) -> ProcessSpec:
    """Return a container for nodes in Python."""
    return ProcessSpec(
        name, module="rosrm.node.container", ros=True, components=components,
        environment={"PYTHONPATH": str(ROOT)}, **fields,
    )  # fmt: skip


def test_components_are_loaded_after_each_start_and_each_restart(cluster: Cluster) -> None:
    """The container is running when it has all five; names and parameters are those of the spec."""
    components = [
        Component(TALKER, "talker", namespace=f"/arm_{number}", parameters={"says": f"{number}"})
        for number in range(5)
    ]
    restart = RestartPolicy("on-failure", delay=0.05)
    cluster.submit(container("five", *components, restart=restart))
    row = cluster.wait("five", "running")
    loaded = [f"/arm_{number}/talker says {number}" for number in range(5)]
    assert said(cluster, "five") == loaded
    os.kill(row.pid, signal.SIGKILL)
    cluster.wait("five", "running", restarts=1)
    assert said(cluster, "five") == loaded * 2
    cluster.cancel("five")


def said(cluster: Cluster, name: str) -> list[str]:
    """Return what the components of a container have printed in all runs, in order."""
    lines = cluster.log(name).splitlines()
    return ["/arm_" + line.partition("/arm_")[2] for line in lines if "/talker says" in line]


def test_a_moved_container_has_its_components_again(cluster: Cluster) -> None:
    """The old one has ended before the new one starts: both would answer a request to load."""
    talker = Component(TALKER, "talker", parameters={"says": "moved"})
    cluster.submit(container("mover", talker, migration=MigrationPolicy("relaunch")))
    source = cluster.wait("mover", "running").host
    cluster.client.migrate("mover", None)
    cluster.wait_for_event("migrated", process="mover")
    row = cluster.wait("mover", "running")
    assert row.host != source
    assert "/talker says moved" in cluster.log("mover")
    cluster.cancel("mover")


def test_a_component_that_cannot_be_loaded_fails_its_container(cluster: Cluster) -> None:
    """The process says which, and what its constructor raised."""
    good, bad = Component(TALKER, "good"), Component(BROKEN, "bad")
    cluster.submit(container("half", good, bad, restart=RestartPolicy("never")))
    reason = cluster.wait("half", "failed").reason
    assert "the component /bad cannot be loaded: " in reason
    assert "OSError: no device here" in reason
