"""A stateful process that crashes, or loses its host, goes on from its last state."""

from __future__ import annotations

import os
import signal
import sys
from pathlib import Path

import pytest

from rosrm import kept
from rosrm.core.model import MigrationPolicy, ProcessSpec, Readiness, RestartPolicy
from tests.ros.clusters import CALM, PATIENCE, STEADY, Cluster, host, wait_until

pytestmark = pytest.mark.timeout(120)

#: Counts, and says each count; what is large in its state is as large as its argument says.
COUNTER = """
import sys
import rclpy
from rclpy.executors import ExternalShutdownException
from std_msgs.msg import Int64, UInt8MultiArray
from rosrm.node import Node

class Counter(Node):
    def __init__(self):
        super().__init__("counter")
        self.count = 0
        self.ballast = bytes(int(sys.argv[1]))
        self.keep_state("~/state", Int64, lambda: Int64(data=self.count), self.restore)
        self.keep_state("~/ballast", UInt8MultiArray, self.save_ballast, self.restore_ballast)
        self.create_timer(0.02, self.tick)
        print("begins", flush=True)

    def tick(self):
        self.count += 1
        if self.ballast:
            self.ballast = bytes([self.count % 256]) + self.ballast[1:]
        print("count", self.count, flush=True)

    def save_ballast(self):
        return UInt8MultiArray(data=self.ballast)

    def restore(self, state):
        self.count = state.data

    def restore_ballast(self, message):
        self.ballast = bytes(message.data)
        assert not self.ballast or self.ballast[0] == self.count % 256

rclpy.init()
try:
    rclpy.spin(Counter())
except (KeyboardInterrupt, ExternalShutdownException):
    pass
"""


def counter(ballast: int = 0, **options) -> ProcessSpec:
    options.setdefault("restart", RestartPolicy("always", delay=0.1, attempts=100))
    return ProcessSpec(
        "counter", command=(sys.executable, "-c", COUNTER, str(ballast)), ros=True, stop=CALM,
        readiness=Readiness(timeout=PATIENCE), migration=MigrationPolicy("handoff"), **options,
    )  # fmt: skip


def kept_directory(cluster: Cluster, on: str) -> Path:
    return cluster.directory / "hosts" / on / "kept" / "counter"


def counts(log: str) -> list[list[int]]:
    """What each run has counted."""
    runs: list[list[int]] = []
    for line in log.splitlines():
        word, _, number = line.partition(" ")
        if word == "begins":
            runs.append([])
        elif word == "count":
            runs[-1].append(int(number))
    return runs


def wait_for_count(cluster: Cluster, at_least: int, run: int = 0) -> list[list[int]]:
    """Until so many runs have begun, and the last has counted so far."""

    def so_far() -> bool:
        runs = counts(cluster._log_so_far("counter"))
        return len(runs) > run and bool(runs[run]) and runs[run][-1] >= at_least

    wait_until(so_far, f"run {run} counts {at_least}", PATIENCE)
    return counts(cluster.log("counter"))


def test_a_killed_node_goes_on_from_its_last_state(make_cluster):
    """Its supervisor starts it again, without a word of the master, and it says so."""
    cluster = make_cluster(host("h0"), liveness=STEADY)
    cluster.submit(counter())
    for run in range(3):
        wait_for_count(cluster, 20 * (run + 1), run)
        row = cluster.wait("counter", "running")
        os.kill(row.pid, signal.SIGKILL)
        runs = wait_for_count(cluster, 1, run + 1)
        # A cycle that was begun may be done again; of a small state each cycle is kept.
        last, first = runs[run][-1], runs[run + 1][0]
        assert last - 10 <= first <= last + 1, runs
        assert runs[run] == list(range(runs[run][0], last + 1))
    cluster.wait_for_log("counter", "goes on from the state kept of counter#")


def test_a_large_state_is_kept_too(make_cluster):
    """5 MB, of which both parts belong together."""
    cluster = make_cluster(host("h0"), liveness=STEADY)
    cluster.submit(counter(5_000_000))
    runs = wait_for_count(cluster, 100)
    os.kill(cluster.wait("counter", "running").pid, signal.SIGKILL)
    runs = wait_for_count(cluster, 1, 1)
    # By default a state may be a second behind; a busy machine needs its time to write it.
    assert runs[1][0] >= 20, runs
    found = kept.newest_head(kept_directory(cluster, "h0"))
    assert found is not None
    assert found.size > 5_000_000


def test_an_orderly_restart_loses_no_cycle(make_cluster):
    """The last state is kept at the end, however seldom a large one is kept else."""
    cluster = make_cluster(host("h0"), liveness=STEADY)
    cluster.submit(counter(2_000_000))
    wait_for_count(cluster, 30)
    cluster.client.restart(["counter"])
    runs = wait_for_count(cluster, 1, 1)
    assert runs[1][0] == runs[0][-1] + 1


def test_a_state_that_cannot_be_restored_stays_as_it_is(make_cluster):
    """The node says why and fails, by its restart policy; what is kept is not overwritten."""
    cluster = make_cluster(host("h0"), liveness=STEADY)
    cluster.submit(counter(restart=RestartPolicy("on-failure", delay=0.1, attempts=2)))
    wait_for_count(cluster, 20)
    directory = kept_directory(cluster, "h0")
    os.kill(cluster.wait("counter", "running").pid, signal.SIGSTOP)
    strange = rewritten(directory)
    os.kill(cluster.wait("counter", "running").pid, signal.SIGKILL)
    cluster.wait("counter", "failed")
    log = cluster.wait_for_log("counter", "cannot be restored")
    assert "another version of the program" in log
    assert kept.newest_content(directory)[1] == strange


def rewritten(directory: Path) -> bytes:
    """Leaves the state of another program there: one without parts."""
    from rclpy.serialization import deserialize_message, serialize_message

    from rosrm_msgs.msg import StateMark

    found, _ = kept.newest(directory, 99)
    mark = deserialize_message(found.blocks[0], StateMark)
    mark.parts = []
    data = bytes(serialize_message(mark))
    writer = kept.SlotWriter(directory, "counter", found.head.instance)
    import zlib

    writer.write(found.head.sequence + 1, [kept.Block(data, zlib.crc32(data))])
    writer.close()
    return kept.newest_content(directory)[1]
