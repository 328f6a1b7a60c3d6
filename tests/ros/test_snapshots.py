"""Restarts of stateful processes from their last snapshot, after crashes and host losses."""

from __future__ import annotations

import base64
import contextlib
import os
import signal
import sys
import zlib
from pathlib import Path

import pytest
from rclpy.serialization import deserialize_message, serialize_message

from rosrm.config.settings import CheckpointPolicySettings, KeepSettings, LivenessSettings
from rosrm.keys.finding import master_security
from rosrm.model.values import (
    HostLossPolicy,
    MigrationPolicy,
    ProcessSpec,
    Readiness,
    RestartPolicy,
)
from rosrm.snapshots import reader
from rosrm.snapshots.format import Block
from rosrm.snapshots.writer import SlotWriter
from rosrm.supervisor import procfs
from rosrm_msgs.msg import StateMark
from tests.ros.clusters import CALM, STEADY, Cluster, host
from tests.waiting import PATIENCE, wait_until

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


def counter(name: str, ballast: int = 0, **options) -> ProcessSpec:
    options.setdefault("restart", RestartPolicy("always", delay=0.1, attempts=100))
    return ProcessSpec(
        name, command=(sys.executable, "-c", COUNTER, str(ballast)), ros=True, stop=CALM,
        readiness=Readiness(timeout=PATIENCE), migration=MigrationPolicy("handoff"), **options,
    )  # fmt: skip


def snapshot_directory(cluster: Cluster, on: str, name: str) -> Path:
    return cluster.directory / "hosts" / on / "kept" / name


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


def wait_for_count(cluster: Cluster, name: str, at_least: int, run: int = 0) -> list[list[int]]:
    """Wait until run number `run` has counted to `at_least`; return the counts of all runs."""

    def so_far() -> list[list[int]]:
        runs = counts(cluster._log_so_far(name))
        return runs if len(runs) > run and runs[run] and runs[run][-1] >= at_least else []

    return wait_until(so_far, f"run {run} counts {at_least}")


def kill(cluster: Cluster, name: str) -> None:
    os.kill(cluster.wait(name, "running").pid, signal.SIGKILL)


# --- on the same host ---------------------------------------------------------------------------


@pytest.fixture(scope="module")
def cluster(make_shared):
    return make_shared(host("h0"), host("h1"))


def test_a_killed_node_continues_from_its_snapshot(cluster):
    """The supervisor restarts the node from its snapshot, without the master, and logs this."""
    cluster.submit(counter("killed"))
    for run in range(3):
        wait_for_count(cluster, "killed", 20 * (run + 1), run)
        kill(cluster, "killed")
        runs = wait_for_count(cluster, "killed", 1, run + 1)
        # An incomplete cycle may repeat; on a busy machine the snapshot may be a second behind.
        last, first = runs[run][-1], runs[run + 1][0]
        assert max(2, last - 60) <= first <= last + 1, runs
        assert runs[run] == list(range(runs[run][0], last + 1))
    cluster.wait_for_log("killed", "continues from the snapshot of killed#")
    cluster.cancel("killed")


def test_a_large_snapshot(cluster):
    """A snapshot of 5 MB is consistent in both its parts."""
    cluster.submit(counter("large", 5_000_000))
    wait_for_count(cluster, "large", 100)
    row = cluster.wait("large", "running")
    kill(cluster, "large")
    runs = wait_for_count(cluster, "large", 1, 1)
    # By default a snapshot may be a second behind; a busy machine takes time to write it.
    assert runs[1][0] >= 20, runs
    assert reader.newest_head(snapshot_directory(cluster, row.host, "large")).size > 5_000_000
    cluster.cancel("large")


def test_an_orderly_restart_loses_no_cycle(cluster):
    """A restart by order saves a last snapshot, however rare those of a large state are."""
    cluster.submit(counter("ordered", 2_000_000))
    wait_for_count(cluster, "ordered", 30)
    cluster.client.restart(["ordered"])
    runs = wait_for_count(cluster, "ordered", 1, 1)
    assert runs[1][0] == runs[0][-1] + 1
    cluster.cancel("ordered")


def test_a_snapshot_that_cannot_be_restored_stays_as_it_is(cluster):
    """The node logs the reason and fails by its restart policy; the snapshot is not overwritten."""
    cluster.submit(counter("other", restart=RestartPolicy("on-failure", delay=0.1, attempts=2)))
    wait_for_count(cluster, "other", 20)
    row = cluster.wait("other", "running")
    directory = snapshot_directory(cluster, row.host, "other")
    os.kill(row.pid, signal.SIGSTOP)
    foreign = rewritten(directory)
    os.kill(row.pid, signal.SIGKILL)
    cluster.wait("other", "failed")
    log = cluster.wait_for_log("other", "cannot be restored")
    assert "another version of the program" in log
    assert reader.newest_content(directory)[1] == foreign


def rewritten(directory: Path) -> bytes:
    """Write the snapshot of another program, without parts; return its content."""
    found, _ = reader.newest(directory, 99)
    mark = deserialize_message(found.blocks[0], StateMark)
    mark.parts = []
    data = bytes(serialize_message(mark))
    writer = SlotWriter(directory, "other", found.head.instance)
    writer.write(found.head.sequence + 1, [Block(data, zlib.crc32(data))])
    writer.close()
    return reader.newest_content(directory)[1]


def test_a_process_that_is_submitted_again_begins_from_nothing(cluster):
    """A cancellation deletes the process's snapshots on every host."""
    cluster.submit(counter("again"))
    wait_for_count(cluster, "again", 20)
    wait_for_copy(cluster, "again", 20)
    cluster.cancel("again")
    wait_until(
        lambda: not any(snapshot_directory(cluster, on, "again").exists() for on in cluster.slaves),
        "no snapshot is left",
    )
    cluster.submit(counter("again"))
    assert wait_for_count(cluster, "again", 1)[0][0] == 1
    cluster.cancel("again")


def test_a_node_runs_where_no_snapshot_can_be_written(make_cluster):
    """The node runs without snapshots, as on a full disk, and logs this once."""
    cluster = make_cluster(host("h0"), liveness=STEADY)
    (cluster.directory / "hosts" / "h0" / "kept").write_text("in the way")
    cluster.submit(counter("counter"))
    wait_for_count(cluster, "counter", 200)
    log = cluster.log("counter")
    assert log.count("its state is not saved: Not a directory") == 1, log


def test_a_host_without_room_refuses_the_replica_and_logs_this_once(make_cluster):
    """The process runs on with a local snapshot only; the refusal is logged once."""
    hosts = [host(f"h{n}", keep=KeepSettings(max_bytes=1_000_000)) for n in range(2)]
    cluster = make_cluster(*hosts, liveness=STEADY)
    cluster.submit(counter("counter", 2_000_000))
    here = cluster.wait("counter", "running").host
    wait_until(lambda: "does not keep the state" in cluster.log_of(here), "the refusal")
    wait_for_count(cluster, "counter", 100)
    assert cluster.log_of(here).count("does not keep the state") == 1
    assert copies(cluster, "counter") == {}


def test_a_migrated_process_continues_from_the_snapshot_on_its_new_host(make_cluster):
    """The snapshot on the old host is older, and is dropped."""
    cluster = make_cluster(
        host("h0"), host("h1"), liveness=STEADY, checkpoint=CheckpointPolicySettings(None)
    )
    cluster.submit(counter("counter"))
    source = cluster.wait("counter", "running").host
    wait_for_count(cluster, "counter", 50)
    cluster.client.migrate("counter")
    cluster.wait_for_event("migrated", process="counter")
    cluster.wait("counter", "running")
    wait_for_count(cluster, "counter", 100)
    old = snapshot_directory(cluster, source, "counter")
    wait_until(lambda: not old.exists(), "the old snapshot is dropped")
    kill(cluster, "counter")
    runs = wait_for_count(cluster, "counter", 1, 1)
    assert runs[1][0] >= runs[0][-1] - 60, runs


# --- on other hosts ---------------------------------------------------------------------------


@pytest.fixture(scope="module")
def three(make_shared):
    """Yield a cluster of three hosts that are lost after 3 s of silence."""
    hosts = [host(f"h{n}") for n in range(3)]
    return make_shared(*hosts, liveness=LivenessSettings(suspect=1.0, lease=3.0))


class Replicated:
    """A counter that goes elsewhere when its host is lost, and a replica up to cycle 50.

    Attributes:
        source: the counter's host.
        keeper: the replica's host.
    """

    def __init__(self, cluster: Cluster, name: str, ballast: int = 0) -> None:
        self.cluster, self.name = cluster, name
        cluster.submit(counter(name, ballast, host_loss=HostLossPolicy("elsewhere")))
        self.source = cluster.wait(name, "running").host
        wait_for_count(cluster, name, 50)
        self.keeper = wait_for_copy(cluster, name, 50)
        assert self.keeper != self.source

    def lose_host(self):
        """Switch the source off; return the row of the process on its next host."""
        self.cluster.switch_off(self.source)
        return self.restarted()

    def restarted(self):
        self.cluster.wait_for_event("given_up", process=self.name)
        return self.cluster.wait(self.name, "running")

    def end(self) -> None:
        self.cluster.start_slave_again(self.source)
        self.cluster.cancel(self.name)
        self.cluster.wait_for_hosts()


def copies(cluster: Cluster, name: str) -> dict[str, int]:
    """Return the last cycle of the replica on each host that has one."""
    found = {}
    for on in cluster.slaves:
        head = reader.peek(snapshot_directory(cluster, on, name) / reader.COPY)
        if head is not None:
            found[on] = head.sequence
    return found


def wait_for_copy(cluster: Cluster, name: str, at_least: int) -> str:
    """Wait until another host has a replica up to this cycle; return the host's name."""
    there = wait_until(
        lambda: [on for on, cycle in copies(cluster, name).items() if cycle >= at_least],
        f"a replica up to cycle {at_least}",
    )
    return there[0]


def test_a_process_of_a_lost_host_continues_on_the_host_of_the_replica(three):
    """The process restarts on the host with the replica, preferred to others with as much room."""
    process = Replicated(three, "lost", 5_000_000)
    before = copies(three, "lost")[process.keeper]
    assert process.lose_host().host == process.keeper
    assert wait_for_count(three, "lost", before)[0][0] > before
    three.wait_for_log("lost", "continues from the snapshot of lost#")
    process.end()


def test_after_a_loss_of_power_a_process_continues_from_the_newer_replica(three):
    """The slots on its host are from before the loss; the process still starts on this host."""
    three.submit(counter("dark"))
    source = three.wait("dark", "running").host
    wait_for_count(three, "dark", 10)
    slots = [snapshot_directory(three, source, "dark") / name for name in reader.SLOTS]
    on_disk = {slot: slot.read_bytes() for slot in slots}
    wait_for_copy(three, "dark", 100)
    since = three.client.list().last_sequence
    three.switch_off(source)
    for slot, content in on_disk.items():
        slot.write_bytes(content)
    for name in ("instances.jsonl", "heard"):
        path = three.directory / "hosts" / source / "supervisor" / name
        path.write_bytes(path.read_bytes().replace(procfs.boot_id().encode(), b"0" * 36))
    three.start_slave_again(source)
    three.wait_for_event("assigned", "its newest snapshot is cycle", after=since, process="dark")
    assert three.wait("dark", "running").host == source
    assert wait_for_count(three, "dark", 100)[0][0] > 100
    three.cancel("dark")


def test_a_host_without_the_replica_fetches_the_snapshot(three):
    """The host with the replica may be cordoned: another host fetches the snapshot."""
    process = Replicated(three, "fetched", 1_000_000)
    before = copies(three, "fetched")[process.keeper]
    three.client.set_host_state(process.keeper, "cordon")
    after = process.lose_host()
    assert after.host not in (process.keeper, process.source)
    assert wait_for_count(three, "fetched", before)[0][0] > before
    assert f"was fetched from {process.keeper}" in three.log_of(after.host)
    three.client.set_host_state(process.keeper, "uncordon")
    process.end()


def test_a_snapshot_that_cannot_be_fetched_delays_no_start(three):
    """The host with the replica is also silent: the process starts without a snapshot, once."""
    process = Replicated(three, "unfetched", 1_000_000)
    before = three.client.list().last_sequence
    three.switch_off(process.source)
    three.wait_for_event("host_suspect", host=process.source, after=before)
    keeper = three.slaves[process.keeper].process
    keeper.send_signal(signal.SIGSTOP)
    try:
        assert process.restarted().host not in (process.keeper, process.source)
        assert wait_for_count(three, "unfetched", 1)[0][0] == 1
        assert three.kinds("unfetched").count("assigned") == 2
    finally:
        keeper.send_signal(signal.SIGCONT)
    process.end()


def test_a_restarted_master_knows_the_hosts_of_replicas(three):
    """Slaves report replicas to a restarted master, which informs them; its journal has none."""
    process = Replicated(three, "known")
    three.restart_master()
    three.wait_for_hosts()
    three.wait("known", "running")
    at = copies(three, "known")[process.keeper]
    assert wait_for_copy(three, "known", at + 100) == process.keeper
    before = copies(three, "known")[process.keeper]
    assert process.lose_host().host == process.keeper
    assert wait_for_count(three, "known", before)[0][0] > before
    process.end()


def test_replication_continues_after_a_restart_of_the_replicas_slave(make_cluster):
    """The ticket of the sender names the former run, so the sender asks for another one at once."""
    two = make_cluster(host("h0"), host("h1"), liveness=STEADY)
    process = Replicated(two, "continued")
    two.start_slave_again(process.keeper)
    at = copies(two, "continued")[process.keeper]
    wait_for_copy(two, "continued", at + 100)
    two.cancel("continued")


# --- encrypted --------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def patient(make_shared):
    """Yield a cluster in which a slave may start again before its host is lost."""
    hosts = [host(f"h{n}") for n in range(3)]
    return make_shared(*hosts, liveness=LivenessSettings(suspect=3.0, lease=15.0))


@pytest.mark.parametrize("fetched", [False, True], ids=["on the replica's host", "on a third host"])
def test_a_successor_of_a_lost_host_decrypts_the_replica(patient, fetched):
    """The host that stores the replica has neither the state nor the key.

    Master and slave of the source were restarted: the slave has the key on its disk, and the master
    derives it again from its secret.
    """
    name = f"secret_{'fetched' if fetched else 'kept'}"
    process = Replicated(patient, name, 1_000_000)
    patient.restart_master()
    patient.wait_for_hosts()
    patient.start_slave_again(process.source)
    at = max(copies(patient, name).values(), default=50)
    process.keeper = wait_for_copy(patient, name, at + 50)  # maybe on another host than before
    stored = snapshot_directory(patient, process.keeper, name)
    assert [path.name for path in stored.iterdir() if path.name != "copy.new"] == ["copy"]
    plain = snapshot_directory(patient, process.source, name) / "state.0"
    ballast = plain.read_bytes()[-1000:-100]
    assert ballast == bytes(900)
    assert ballast not in (stored / "copy").read_bytes()
    record = (plain.parent / "key").read_bytes()
    number, key = int.from_bytes(record[:8], "little"), record[8:]
    of_number = master_security("keys").snapshot_key
    assert key in {of_number(name, first) for first in range(1, number + 1)}
    before = copies(patient, name)[process.keeper]
    if fetched:
        patient.client.set_host_state(process.keeper, "cordon")
    after = process.lose_host().host
    assert (after == process.keeper) is not fetched
    assert wait_for_count(patient, name, before)[0][0] > before
    patient.wait_for_log(name, f"continues from the snapshot of {name}#")
    assert_no_key(patient, key)
    if fetched:
        patient.client.set_host_state(process.keeper, "uncordon")
    process.end()
    there = snapshot_directory(patient, after, name)
    wait_until(lambda: not there.exists(), "the key is deleted with the snapshots")


def assert_no_key(cluster: Cluster, key: bytes) -> None:
    """Check that no file of the cluster has the key, but those for it."""
    forms = [key, key.hex().encode(), base64.b64encode(key), str(list(key))[1:-1].encode()]
    found = set()
    for path in filter(Path.is_file, cluster.directory.rglob("*")):
        with contextlib.suppress(FileNotFoundError):  # a new copy gets its final name
            content = path.read_bytes()
            if any(form in content for form in forms):
                found.add(path)
    assert found
    assert {path.name for path in found} == {"key"}, found
