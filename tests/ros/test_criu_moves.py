"""Processes that move with their whole memory: dumped by CRIU, restored on another host."""

from __future__ import annotations

import time
from itertools import pairwise

import pytest
import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import QoSProfile
from std_msgs.msg import Int64MultiArray

from rosrm.config.settings import MigrationSettings, ProcessDefaults
from rosrm.core.model import MigrationPolicy, ProcessSpec, RestartPolicy
from rosrm.errors import Refused
from tests.ros.clusters import MIB, PATIENCE, QUICK, host

BY_CRIU = MigrationPolicy("criu")


class Ear:
    """Hears what a portable counter counts."""

    def __init__(self, domain: int) -> None:
        self._context = rclpy.Context()
        self._context.init(domain_id=domain)
        self._node = rclpy.create_node("ear", context=self._context)
        self._node.create_subscription(Int64MultiArray, "count", self._take, QoSProfile(depth=1000))
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)
        self.counts: list[int] = []
        self.checksums: set[int] = set()

    def _take(self, message: Int64MultiArray) -> None:
        count, passes, checksum = message.data
        self.counts.append(count)
        if passes:
            self.checksums.add(checksum)

    def hear(self, more: int) -> None:
        """So many counts more."""
        wanted, deadline = len(self.counts) + more, time.monotonic() + PATIENCE
        while len(self.counts) < wanted:
            assert time.monotonic() < deadline, f"{len(self.counts)} counts of {wanted}"
            self._executor.spin_once(0.1)

    def close(self) -> None:
        self._node.destroy_node()
        self._context.try_shutdown()


@pytest.fixture(scope="module")
def cluster(make_shared):
    """Two hosts; nothing moves by itself."""
    return make_shared(
        host("left"), host("right"),
        migration=MigrationSettings(strategies={"relaunch": {}, "criu": {}}, automatic=False),
        defaults=ProcessDefaults(needs={"memory": MIB}),
    )  # fmt: skip


@pytest.fixture
def ear(cluster):
    ear = Ear(cluster.domain)
    yield ear
    ear.close()


def counter(name: str = "portable_counter", **fields) -> ProcessSpec:
    fields.setdefault("restart", RestartPolicy("on-failure", delay=0.1))
    return ProcessSpec(
        name, module="rosrm_examples.portable_counter", arguments=("--period", "0.02"), ros=True,
        migration=BY_CRIU, stop=QUICK, **fields,
    )  # fmt: skip


def move(cluster) -> None:
    """Ask for a move, as soon as both hosts have said that they can."""
    deadline = time.monotonic() + PATIENCE
    while (refusal := asked(cluster)) is not None:
        assert "not known yet" in refusal
        assert time.monotonic() < deadline, refusal
        cluster.client.spin(0.1)


def asked(cluster) -> str | None:
    """Why a move is refused; None: it has begun."""
    try:
        cluster.client.migrate("portable_counter")
    except Refused as refusal:
        return str(refusal)
    return None


def moved(cluster, times: int):
    """The process once it has moved so often, and none of its moves has failed."""

    def there(view) -> bool:
        stayed = [event.message for event in cluster.events("stayed")]
        assert not stayed, stayed
        return any(row.migrations == times and row.state == "running" for row in view.processes)

    view = cluster.wait_until(f"{times} moves", there, 60.0)
    return next(row for row in view.processes if row.state == "running")


def test_a_node_counts_on_where_it_is_restored(criu, cluster, ear):
    """No count twice and none left out of what it did, its memory the same, over several moves."""
    cluster.submit(counter())
    cluster.wait("portable_counter", "running")
    ear.hear(50)
    for times in (1, 2, 3):
        before = cluster.process("portable_counter").host
        move(cluster)
        row = moved(cluster, times)
        assert row.host != before
        ear.hear(50)
    # A reader that finds the writer later than that finds it misses the first of what it says.
    steps = [after - before for before, after in pairwise(ear.counts)]
    assert min(steps) == 1
    assert sum(step > 1 for step in steps) <= 3
    assert len(ear.checksums) == 1
    cluster.cancel("portable_counter")
