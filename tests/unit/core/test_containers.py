"""Processes with a container: only hosts that offer its engine take them."""

from __future__ import annotations

from dataclasses import dataclass, replace

from rosrm.core.master.applications.listing import application_rows
from rosrm.model.values import Container, HostDescription, MigrationPolicy
from tests.unit.core.cluster import Cluster, Machine, process


@dataclass(kw_only=True)
class Offering(Machine):
    """Simulated host with some launchers."""

    launchers: tuple[str, ...] = ()

    def description(self) -> HostDescription:
        return replace(super().description(), launchers=self.launchers)


def test_a_container_selects_the_hosts_that_offer_its_engine() -> None:
    """Other processes run on every host."""
    cluster = Cluster(Offering("a"), Offering("b", launchers=("criu", "podman")))
    cluster.submit(process("p", container=Container("ros:jazzy", "podman")))
    assert cluster.where("p") == ["b"]
    hosts = cluster.explain("p")["decision"]["hosts"]
    assert [one["reason"] for one in hosts if one["name"] == "a"] == ["it does not offer podman"]


def test_a_process_waits_until_a_host_offers_its_engine() -> None:
    """Until then it blocks no other process in the queue."""
    cluster = Cluster(Offering("a", launchers=("criu",)))
    cluster.submit(process("p", container=Container("ros:jazzy", "podman")), process("q"))
    assert cluster.where("q") == ["a"]
    reason = cluster.explain("p")["reason"]
    assert (
        "no host offers podman for containers (only criu): install podman and its plugin" in reason
    )


def test_an_application_says_that_no_host_offers_the_engine_of_a_process() -> None:
    """The rest of its first version runs, and `rosrm apply` ends with the reason."""
    cluster = Cluster(Offering("a"))
    camera = process("camera", container=Container("ros:jazzy", "podman"))
    cluster.apply("seeing", process("viewer"), camera)
    cluster.wait(12.0)
    (row,) = application_rows(cluster.state)
    assert (row.state, row.running) == ("degraded", 1)
    assert "camera is set aside: no host may take it: no host offers podman" in row.reason


def test_a_container_cannot_move_by_a_strategy_that_moves_state() -> None:
    """The strategy may be a default of the cluster, which no client knows."""
    cluster = Cluster(Offering("a", launchers=("podman",)))
    image, policy = Container("ros:jazzy", "podman"), MigrationPolicy("handoff")
    answer = cluster.submit(process("p", container=image, migration=policy, ros=True))
    assert "handoff moves the state of a process, which is not possible with" in answer.message
