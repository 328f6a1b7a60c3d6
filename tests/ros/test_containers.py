"""Processes in real containers of podman, on real slaves."""

from __future__ import annotations

import os
import signal
from pathlib import Path

import pytest

from rosrm.model.values import Container, RestartPolicy
from tests.podman_kit import IMAGE, ask, listed, podman  # noqa: F401 - a fixture
from tests.ros.clusters import CALM, STEADY, alive, host, node, service
from tests.waiting import all_commands, wait_until

pytestmark = pytest.mark.usefixtures("podman")

IN_IMAGE = Container(IMAGE, "podman")
#: Prints facts about its surroundings, and the signal that ends it.
SHOW = (
    "trap 'echo interrupted; exit 0' INT; echo $0 $PLAIN ${#TOKEN} $ROSRM_PROCESS;"
    " [ -e /in-image ] && echo inside; while :; do sleep 0.1; done"
)
AT_ONCE = RestartPolicy("on-failure", delay=0.0)


def inside(name: str, **options):
    """Return a process that runs `SHOW` in a container."""
    options.setdefault("container", IN_IMAGE)
    options.setdefault("stop", CALM)  # podman itself needs a moment to remove a container
    return service(name, "sh", "-c", SHOW, "of-image", restart=AT_ONCE, **options)


def processes_of(name: str) -> list[int]:
    """Return all processes of a process of the cluster, in the container and around it."""
    mark, found = f"ROSRM_PROCESS={name}".encode(), []
    for one in Path("/proc").glob("[0-9]*/environ"):
        try:
            if mark in one.read_bytes().split(b"\0"):
                found.append(int(one.parent.name))
        except OSError:
            continue
    return found


def test_a_container_lives_as_long_as_its_process(make_cluster, tmp_path) -> None:
    """Slave and supervisor may be killed and return; a cancel interrupts the program inside."""
    token = tmp_path / "token"
    token.write_bytes(b"hush-4711\n")
    token.chmod(0o600)
    cluster = make_cluster(host("a"), liveness=STEADY)
    cluster.submit(inside("robot", environment={"PLAIN": "x y"}, secrets={"TOKEN": str(token)}))
    assert "inside" in cluster.wait_for_log("robot", "of-image x y 9 robot\ninside")
    pid = cluster.wait("robot", "running", where=lambda row: row.memory > 0).pid
    assert "hush" not in all_commands()

    os.kill(cluster.supervisor("a"), signal.SIGKILL)
    cluster.start_slave_again("a")
    assert cluster.wait("robot", "running").pid == pid
    cluster.cancel("robot")
    cluster.wait_for_log("robot", "interrupted")
    wait_until(lambda: not listed(), "the container is removed", seen=lambda: ask("ps", "--all"))
    wait_until(lambda: not processes_of("robot"), "the end of all around the container")


def test_nothing_survives_a_kill_of_podman_and_the_process_restarts(make_cluster) -> None:
    """The next start removes what podman still lists of the killed container."""
    cluster = make_cluster(host("a"), liveness=STEADY)
    cluster.submit(inside("robot"))
    first = cluster.wait("robot", "running").pid
    wait_until(lambda: len(processes_of("robot")) > 1, "the container runs")
    former = processes_of("robot")
    os.kill(first, signal.SIGKILL)
    cluster.wait("robot", "running", where=lambda row: row.pid not in (0, first))
    wait_until(lambda: not any(map(alive, former)), "the former processes are gone")
    cluster.wait_for_log("robot", "inside")
    assert len(listed()) == 1
    cluster.cancel("robot")


def test_a_node_in_a_container_is_part_of_the_ros_graph(make_cluster) -> None:
    """Its slave sees it there, and its parameters are in the container, too."""
    cluster = make_cluster(host("a"), liveness=STEADY)
    cluster.submit(node("talker", container=IN_IMAGE, parameters={"width": 320}))
    cluster.wait("talker", "running")
    assert cluster.kinds("talker")[-1] == "ready"
    cluster.wait_for_log("talker", '"parameters": {"width": 320}')
    cluster.cancel("talker")
