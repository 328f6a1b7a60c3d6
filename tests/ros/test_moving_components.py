"""Components that are processes of their own, and move with their state between containers."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from itertools import accumulate
from pathlib import Path

import pytest
from std_msgs.msg import Int64

from rosrm.model.applications import Target
from rosrm.model.rows import ProcessRow
from rosrm.model.values import (
    LifecyclePolicy,
    MigrationPolicy,
    ProcessSpec,
    Readiness,
    RestartPolicy,
)
from tests.ros.clusters import CALM, Cluster, host
from tests.ros.nodes import RELIABLE, Stage
from tests.ros.test_handoffs import migrate
from tests.waiting import PATIENCE, wait_gone

pytest.importorskip("composition_interfaces")

ROOT = Path(__file__).resolve().parents[2]
COUNTER = "tests.ros.nodes:Counter"
SHY = "tests.ros.programs.components:Shy"
BROKEN = "tests.ros.programs.components:Broken"
MANAGED = "tests.ros.programs.components:Managed"
STUCK = "tests.ros.programs.components:Stuck"
AGAIN = RestartPolicy("on-failure", delay=0.2)


@pytest.fixture(scope="module")
def cluster(make_shared) -> Cluster:
    """Return a cluster with the container `box` on each of two hosts."""
    cluster = make_shared(host("a", labels={"at": "a"}), host("b", labels={"at": "b"}))
    cluster.submit(*(container(f"box_{at}", at) for at in "ab"))
    for at in "ab":
        cluster.wait(f"box_{at}", "running")
    return cluster


@pytest.fixture
def stage(cluster: Cluster) -> Iterator[Stage]:
    stage = Stage(domain=cluster.domain)
    yield stage
    stage.close()


def container(name: str, at: str, *words: str) -> ProcessSpec:
    """Return a container on one host."""
    return ProcessSpec(
        name, module="rosrm.node.container", arguments=words or ("box",), ros=True, stop=CALM,
        required_labels={"at": at}, environment={"PYTHONPATH": str(ROOT)}, restart=AGAIN,
        readiness=Readiness(timeout=PATIENCE),
    )  # fmt: skip


def component(name: str, plugin: str = COUNTER, box: str = "box", **fields) -> ProcessSpec:
    """Return a component that is a process, in the container of its host."""
    fields = {"restart": AGAIN, "migration": MigrationPolicy("handoff"), **fields}
    return ProcessSpec(
        name, module="rosrm.component", arguments=(box, plugin), ros=True, stop=CALM,
        namespace=f"/{name}", readiness=Readiness(timeout=PATIENCE), **fields,
    )  # fmt: skip


class Feed:
    """Numbers for the counter of a process, and all that it publishes."""

    def __init__(self, stage: Stage, name: str) -> None:
        self._stage = stage
        self._counts = stage.listen(Int64, f"/{name}/count")
        self._sums = stage.listen(Int64, f"/{name}/sum")
        self._sent: list[int] = []
        self._feeder = stage.plain.create_publisher(Int64, f"/{name}/add", RELIABLE)

    def begin(self) -> None:
        """Publish 1, 2, 3, ... at 100 Hz from now on."""
        self._stage.spin_until(
            lambda: self._feeder.get_subscription_count() and self._counts, "the counter"
        )
        self._stage.plain.create_timer(0.01, self._feed)

    def _feed(self) -> None:
        self._sent.append(len(self._sent) + 1)
        self._feeder.publish(Int64(data=self._sent[-1]))

    def go_on(self) -> None:
        """Wait for further sums."""
        start = len(self._sums)
        self._stage.spin_until(lambda: len(self._sums) > start + 30, "further sums")

    def check(self) -> None:
        """Check that each number was added once, and that no tick is missing."""
        numbers = [one.data for one in self._counts]
        assert numbers == list(range(numbers[0], numbers[0] + len(numbers)))
        assert [one.data for one in self._sums] == list(accumulate(self._sent))[: len(self._sums)]


def await_next(cluster: Cluster, stage: Stage, before: ProcessRow) -> ProcessRow:
    """Wait until another instance of a process runs, while the stage spins."""

    def rows() -> list[ProcessRow]:
        found = cluster.client.list(processes=True).processes
        return [
            one for one in found
            if one.name == before.name and one.state == "running" and one.number != before.number
        ]  # fmt: skip

    stage.spin_until(rows, f"the next instance of {before.name}", seen=cluster.events)
    return rows()[0]


def test_a_component_moves_with_its_state_between_containers(cluster, stage) -> None:
    """No message is lost or processed twice, by its timer or its input, in two moves."""
    cluster.submit(component("mover"))
    row = cluster.wait("mover", "running")
    feed = Feed(stage, "mover")
    feed.begin()
    for _ in range(2):
        feed.go_on()
        cluster.client.migrate("mover")
        before, row = row, await_next(cluster, stage, row)
        assert row.host != before.host
    feed.go_on()
    feed.check()
    cluster.cancel("mover")


def test_another_version_of_a_component_names_another_container(cluster, stage) -> None:
    """`rosrm apply` moves it there with its state, also on one host."""
    cluster.submit(container("cabin", "a", "cabin"))
    cluster.wait("cabin", "running")

    def apply(box: str) -> None:
        spec = component("tenant", box=box, required_labels={"at": "a"}, application="house")
        cluster.client.apply([Target("house", (spec,))])

    apply("box")
    before = cluster.wait("tenant", "running")
    feed = Feed(stage, "tenant")
    feed.begin()
    feed.go_on()
    apply("cabin")
    assert await_next(cluster, stage, before).host == "a"
    feed.go_on()
    feed.check()
    cluster.client.apply([Target("house")])
    cluster.ended("tenant")
    cluster.cancel("cabin")


@pytest.mark.parametrize(
    ("name", "fields", "said"),
    [
        ("shy", {"plugin": SHY}, "cannot be loaded: OSError: no device there"),
        ("local", {"box": "only_a", "required_labels": {}}, "no container 'only_a' runs on this"),
    ],
)
def test_a_component_stays_if_it_cannot_be_loaded_there(cluster, stage, name, fields, said) -> None:
    """The source keeps counting in its container, in the same process."""
    if name == "local":
        cluster.submit(container("only_a", "a", "only_a"))
        cluster.wait("only_a", "running")
        cluster.client.set_host_state("b", "cordon")
    counts = stage.listen(Int64, f"/{name}/count")
    cluster.submit(component(name, **fields))
    cluster.wait(name, "running")
    cluster.client.set_host_state("b", "uncordon")
    stage.spin_until(lambda: len(counts) > 5, "counts before the move")
    before, event = migrate(cluster, name)
    assert event.kind == "stayed", event.message
    after = cluster.wait(name, "running")
    assert (after.host, after.pid) == (before.host, before.pid)
    assert said in event.message
    so_far = len(counts)
    stage.spin_until(lambda: len(counts) > so_far + 20, "counts after the move")
    numbers = [one.data for one in counts]
    assert numbers == list(range(numbers[0], numbers[0] + len(numbers)))
    cluster.cancel(name)


def test_a_lifecycle_node_moves_between_containers(cluster) -> None:
    """The slaves of both hosts change the state of the node in the container of their host."""
    policy = LifecyclePolicy("active", PATIENCE)
    moves = MigrationPolicy("lifecycle_node")
    cluster.submit(component("driver", MANAGED, lifecycle=policy, migration=moves))
    before = cluster.wait("driver", "running")
    cluster.client.migrate("driver")
    after = cluster.wait("driver", "running", migrations=1)
    assert after.host != before.host
    for at in "ab":
        assert "/driver/driver is activated" in cluster.log(f"box_{at}")
    cluster.cancel("driver")


def test_a_component_ends_with_its_process_and_starts_again(cluster, stage) -> None:
    """Its node leaves the container, also if the process is killed; the next run has a new one."""
    counts = stage.listen(Int64, "/again/count")
    cluster.submit(component("again", migration=MigrationPolicy()))
    before = cluster.wait("again", "running")
    stage.spin_until(lambda: len(counts) > 20, "counts")
    os.kill(before.pid, signal.SIGKILL)
    cluster.wait("again", "running", restarts=1)
    stage.spin_until(lambda: counts[-1].data < len(counts), "counts of the second run")
    numbers = [one.data for one in counts]
    second = numbers.index(1, 1)
    assert numbers[second:] == list(range(1, len(numbers) - second + 1)), "of one node at a time"
    cluster.cancel("again")
    assert "/again/again" not in graph(stage)


def graph(stage: Stage) -> set[str]:
    """Return the names of all nodes that the stage sees."""
    return {f"{space}/{name}" for name, space in stage.plain.get_node_names_and_namespaces()}


def test_components_start_again_with_their_container(cluster) -> None:
    """The end of a container ends the processes of its components, and they say why."""
    cluster.submit(component("inmate"))
    row = cluster.wait("inmate", "running")
    box = cluster.wait(f"box_{row.host}", "running")
    os.kill(box.pid, signal.SIGKILL)
    wait_gone(row.pid)
    cluster.wait("inmate", "running", where=lambda one: one.restarts > row.restarts)
    assert "the container 'box' has ended" in cluster.log("inmate")
    cluster.cancel("inmate")


def test_a_second_container_of_a_name_on_a_host_follows_the_first(cluster) -> None:
    """A second container logs a warning, and gets the components when the first has ended."""
    cluster.submit(container("first", "a", "twin"))
    cluster.wait("first", "running")
    cluster.submit(container("second", "a", "twin"))
    cluster.wait("second", "running")
    cluster.wait_for_log("second", "another container 'twin' runs on this host")
    cluster.submit(component("child", box="twin", required_labels={"at": "a"}))
    row = cluster.wait("child", "running")
    cluster.cancel("first")
    wait_gone(row.pid)
    cluster.wait("child", "running", where=lambda one: one.restarts > row.restarts)
    cluster.cancel("child", "second")


def test_a_component_that_cannot_be_loaded_has_failed(cluster) -> None:
    """The process says what the constructor raised."""
    cluster.submit(component("broken", BROKEN, restart=RestartPolicy("never")))
    row = cluster.wait("broken", "failed")
    assert row.reason == "exit code 1: cannot be loaded: OSError: no device here"


def test_a_stuck_container_does_not_outlive_a_process_that_was_killed(cluster) -> None:
    """A fence kills the process; its node must not be active beside its successor."""
    cluster.submit(container("cell", "a", "cell"))
    cell = cluster.wait("cell", "running")
    cluster.submit(
        component(
            "stuck", STUCK, "cell", restart=RestartPolicy("never"), required_labels={"at": "a"}
        )
    )
    row = cluster.wait("stuck", "running")
    cluster.wait_for_log("cell", "is stuck")
    os.kill(row.pid, signal.SIGKILL)
    wait_gone(cell.pid)
    cluster.cancel("cell")
