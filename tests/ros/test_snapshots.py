"""Restarts of stateful processes from their last snapshot, after crashes and host losses."""

from __future__ import annotations

import contextlib
import os
import signal
import sys
from pathlib import Path

import pytest

from rosrm import snapshots
from rosrm.config.settings import CheckpointChoice, KeepSettings, LivenessSettings
from rosrm.model.values import (
    HostLossPolicy,
    MigrationPolicy,
    ProcessSpec,
    Readiness,
    RestartPolicy,
)
from tests.ros.clusters import CALM, PATIENCE, STEADY, Cluster, host, pids_of, wait_gone, wait_until

pytestmark = pytest.mark.timeout(120)

#: Prints each count; the large part of its state has the size given as argument.
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
    """Return the counts of each run."""
    runs: list[list[int]] = []
    for line in log.split("\n")[:-1]:  # the last line may be incomplete
        word, _, number = line.partition(" ")
        if word == "begins":
            runs.append([])
        elif word == "count":
            runs[-1].append(int(number))
    return runs


def wait_for_count(cluster: Cluster, at_least: int, run: int = 0) -> list[list[int]]:
    """Wait until run number `run` has counted to `at_least`; return the counts of all runs."""

    def so_far() -> bool:
        runs = counts(cluster._log_so_far("counter"))
        return len(runs) > run and bool(runs[run]) and runs[run][-1] >= at_least

    wait_until(so_far, f"run {run} counts {at_least}", PATIENCE)
    return counts(cluster.log("counter"))


def test_a_killed_node_goes_on_from_its_last_state(make_cluster):
    """The supervisor restarts the node from its snapshot, without the master, and logs this."""
    cluster = make_cluster(host("h0"), liveness=STEADY)
    cluster.submit(counter())
    for run in range(3):
        wait_for_count(cluster, 20 * (run + 1), run)
        row = cluster.wait("counter", "running")
        os.kill(row.pid, signal.SIGKILL)
        runs = wait_for_count(cluster, 1, run + 1)
        # An incomplete cycle may repeat; on a busy machine the snapshot may be a second behind.
        last, first = runs[run][-1], runs[run + 1][0]
        assert max(2, last - 60) <= first <= last + 1, runs
        assert runs[run] == list(range(runs[run][0], last + 1))
    cluster.wait_for_log("counter", "continues from the snapshot of counter#")


def test_a_large_state_is_kept_too(make_cluster):
    """A snapshot of 5 MB is consistent in both its parts."""
    cluster = make_cluster(host("h0"), liveness=STEADY)
    cluster.submit(counter(5_000_000))
    runs = wait_for_count(cluster, 100)
    os.kill(cluster.wait("counter", "running").pid, signal.SIGKILL)
    runs = wait_for_count(cluster, 1, 1)
    # By default a snapshot may be a second behind; a busy machine takes time to write it.
    assert runs[1][0] >= 20, runs
    found = snapshots.newest_head(kept_directory(cluster, "h0"))
    assert found is not None
    assert found.size > 5_000_000


def test_an_orderly_restart_loses_no_cycle(make_cluster):
    """A restart by order saves a last snapshot, however rare those of a large state are."""
    cluster = make_cluster(host("h0"), liveness=STEADY)
    cluster.submit(counter(2_000_000))
    wait_for_count(cluster, 30)
    cluster.client.restart(["counter"])
    runs = wait_for_count(cluster, 1, 1)
    assert runs[1][0] == runs[0][-1] + 1


def test_a_state_that_cannot_be_restored_stays_as_it_is(make_cluster):
    """The node logs the reason and fails by its restart policy; the snapshot is not overwritten."""
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
    assert snapshots.newest_content(directory)[1] == strange


def rewritten(directory: Path) -> bytes:
    """Write the snapshot of another program, without parts; return its content."""
    from rclpy.serialization import deserialize_message, serialize_message

    from rosrm_msgs.msg import StateMark

    found, _ = snapshots.newest(directory, 99)
    mark = deserialize_message(found.blocks[0], StateMark)
    mark.parts = []
    data = bytes(serialize_message(mark))
    writer = snapshots.SlotWriter(directory, "counter", found.head.instance)
    import zlib

    writer.write(found.head.sequence + 1, [snapshots.Block(data, zlib.crc32(data))])
    writer.close()
    return snapshots.newest_content(directory)[1]


# --- on other hosts ---------------------------------------------------------------------------

QUICK_LEASE = LivenessSettings(suspect=1.0, lease=3.0)
ELSEWHERE = HostLossPolicy("elsewhere")


def kill_host(cluster: Cluster, name: str) -> None:
    """Kill the slave, the supervisor and the processes of a host, as a power cut does."""
    row = cluster.client.list(processes=True).processes[0]
    slave = cluster.slaves.pop(name)
    slave.process.kill()  # first, because it would start another supervisor
    slave.process.wait(PATIENCE)
    mark = str(cluster.directory / "hosts" / name)
    victims = [pid for pid, command in pids_of(cluster.directory).items() if mark in command]
    for pid in (*victims, row.pid):
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)
    wait_gone(row.pid)


def copies(cluster: Cluster) -> dict[str, int]:
    """Return the last cycle of the replica on each host that has one."""
    found = {}
    for name in cluster.slaves:
        head = snapshots.peek(kept_directory(cluster, name) / snapshots.COPY)
        if head is not None:
            found[name] = head.sequence
    return found


def wait_for_copy(cluster: Cluster, at_least: int, on: str | None = None) -> str:
    """Wait until another host has a replica up to this cycle; return the host's name."""

    def there() -> list[str]:
        return [
            name for name, cycle in copies(cluster).items()
            if cycle >= at_least and on in (None, name)
        ]  # fmt: skip

    wait_until(there, f"a copy up to cycle {at_least}", PATIENCE)
    return there()[0]


@pytest.mark.parametrize("ballast", [0, 5_000_000])
def test_when_its_host_is_lost_it_goes_on_elsewhere_from_the_kept_state(make_cluster, ballast):
    """The process restarts on the host with the replica, preferred to others with as much room."""
    cluster = make_cluster(*(host(f"h{n}") for n in range(3)), liveness=QUICK_LEASE)
    cluster.submit(counter(ballast, host_loss=ELSEWHERE))
    row = cluster.wait("counter", "running")
    wait_for_count(cluster, 50)
    keeper = wait_for_copy(cluster, 50)
    assert keeper != row.host
    before = copies(cluster)[keeper]
    kill_host(cluster, row.host)
    cluster.wait_for_event("given_up", process="counter")
    after = cluster.wait("counter", "running")
    assert after.host == keeper
    runs = wait_for_count(cluster, before)
    assert runs[0][0] > before
    cluster.wait_for_log("counter", "continues from the snapshot of counter#")


def test_a_host_that_does_not_keep_the_state_fetches_it(make_cluster):
    """The host with the replica may be cordoned: another host fetches the snapshot."""
    cluster = make_cluster(*(host(f"h{n}") for n in range(3)), liveness=QUICK_LEASE)
    cluster.submit(counter(1_000_000, host_loss=ELSEWHERE))
    row = cluster.wait("counter", "running")
    wait_for_count(cluster, 50)
    keeper = wait_for_copy(cluster, 50)
    before = copies(cluster)[keeper]
    cluster.client.set_host_state(keeper, "cordon")
    kill_host(cluster, row.host)
    cluster.wait_for_event("given_up", process="counter")
    after = cluster.wait("counter", "running")
    assert after.host not in (keeper, row.host)
    runs = wait_for_count(cluster, before)
    assert runs[0][0] > before
    assert f"was fetched from {keeper}" in cluster.log_of(after.host)


def test_a_process_that_is_submitted_anew_begins_from_nothing(make_cluster):
    """A cancellation deletes the process's snapshots on every host."""
    cluster = make_cluster(host("h0"), host("h1"), liveness=STEADY)
    cluster.submit(counter())
    wait_for_count(cluster, 20)
    wait_for_copy(cluster, 20)
    cluster.cancel("counter")
    wait_until(
        lambda: not any(kept_directory(cluster, name).exists() for name in cluster.slaves),
        "nothing is kept any more", PATIENCE,
    )  # fmt: skip
    cluster.submit(counter())
    assert wait_for_count(cluster, 1)[0][0] == 1


def test_a_host_without_room_refuses_and_says_so_once(make_cluster):
    """The process runs on with a local snapshot only; the refusal is logged once."""
    hosts = [host(f"h{n}", keep=KeepSettings(max_bytes=1_000_000)) for n in range(2)]
    cluster = make_cluster(*hosts, liveness=STEADY)
    cluster.submit(counter(2_000_000))
    row = cluster.wait("counter", "running")
    said = row.host
    wait_until(lambda: "does not keep the state" in cluster.log_of(said), "the refusal", PATIENCE)
    wait_for_count(cluster, 100)
    assert cluster.log_of(said).count("does not keep the state") == 1
    assert copies(cluster) == {}


def test_a_state_that_cannot_be_fetched_holds_up_no_start(make_cluster):
    """The host with the replica is also silent: the process starts without a snapshot, once."""
    cluster = make_cluster(*(host(f"h{n}") for n in range(3)), liveness=QUICK_LEASE)
    cluster.submit(counter(1_000_000, host_loss=ELSEWHERE))
    row = cluster.wait("counter", "running")
    wait_for_count(cluster, 50)
    keeper = wait_for_copy(cluster, 50)
    kill_host(cluster, row.host)
    cluster.wait_for_event("host_suspect", host=row.host)
    stopped = cluster.slaves[keeper].process
    os.kill(stopped.pid, signal.SIGSTOP)
    try:
        cluster.wait_for_event("given_up", process="counter")
        after = cluster.wait("counter", "running")
        assert after.host not in (keeper, row.host)
        assert wait_for_count(cluster, 1)[0][0] == 1
        assert cluster.kinds("counter").count("assigned") == 2
    finally:
        os.kill(stopped.pid, signal.SIGCONT)


def test_a_moved_process_goes_on_from_the_state_that_its_new_host_keeps(make_cluster):
    """The snapshot on the old host is older, and is dropped."""
    cluster = make_cluster(
        host("h0"), host("h1"), liveness=STEADY, checkpoint=CheckpointChoice(None)
    )
    cluster.submit(counter())
    row = cluster.wait("counter", "running")
    wait_for_count(cluster, 50)
    (other,) = cluster.slaves.keys() - {row.host}
    cluster.client.migrate("counter", other)
    cluster.wait_for_event("migrated", process="counter")
    moved = cluster.wait("counter", "running")
    runs = wait_for_count(cluster, 100)
    wait_until(lambda: not kept_directory(cluster, row.host).exists(), "the old state is dropped")
    os.kill(moved.pid, signal.SIGKILL)
    runs = wait_for_count(cluster, 1, 1)
    assert runs[1][0] >= runs[0][-1] - 60, runs


def test_a_node_goes_on_where_nothing_can_be_kept(make_cluster):
    """The node runs without snapshots, as on a full disk, and logs this once."""
    cluster = make_cluster(host("h0"), liveness=STEADY)
    (cluster.directory / "hosts" / "h0" / "kept").write_text("in the way")
    cluster.submit(counter())
    wait_for_count(cluster, 200)
    log = cluster.log("counter")
    assert log.count("its state is not saved: Not a directory") == 1, log


def test_a_master_that_was_started_again_knows_where_states_lie(make_cluster):
    """Slaves report replicas to a restarted master, which informs them; its journal has none."""
    cluster = make_cluster(host("h0"), host("h1"), liveness=QUICK_LEASE)
    cluster.submit(counter(host_loss=ELSEWHERE))
    row = cluster.wait("counter", "running")
    keeper = wait_for_copy(cluster, 50)
    cluster.master.process.kill()
    cluster.master.process.wait(PATIENCE)
    cluster.reconnect()
    cluster.start_master()
    cluster.wait_for_hosts()
    cluster.wait("counter", "running")
    at = copies(cluster)[keeper]
    before = copies(cluster)[wait_for_copy(cluster, at + 100)]
    kill_host(cluster, row.host)
    cluster.wait_for_event("given_up", process="counter")
    assert cluster.wait("counter", "running").host == keeper
    assert wait_for_count(cluster, before)[0][0] > before
