"""Snapshot replication at the slave: ship, receive, fetch, delete; with files, without ROS."""

from __future__ import annotations

import logging
import os
import queue
import stat
import threading
import zlib
from collections.abc import Callable

import pytest

from rosrm import clocks
from rosrm.config.settings import KeepSettings
from rosrm.model.values import Assignment, InstanceId, MigrationPolicy, ProcessSpec
from rosrm.ros.slave.replication import NotSent, NotStored
from rosrm.slave.replication.service import ReplicationService
from rosrm.snapshots import reader
from rosrm.snapshots.format import Block, TransferPart
from rosrm.snapshots.writer import SlotWriter

P7 = InstanceId("p", 7)
PATIENCE = 20.0


class Wire:
    """Transport without ROS: messages between slaves arrive at once, unless a host is cut off."""

    def __init__(self, net: Net, name: str) -> None:
        self.net, self.name = net, name
        self.host = None
        self.given: list[TransferPart] = []

    def serve(self, host) -> None:
        self.host = host

    def finds_receiver(self, host: str, process: str, now: float) -> bool:
        return host not in self.net.hidden

    finds_source = finds_receiver

    def give(self, host, part, now, timeout, done) -> None:
        self.given.append(part)
        if host in self.net.silent:
            self.net.unanswered.append(lambda: done(NotStored("timeout", "no answer")))
        elif self.net.takes_stale(host):
            done(NotStored("stale", "keys have changed"))
        else:
            self.net.slaves[host].take_part(part, done)

    def ask(self, host, request, now, timeout, done) -> None:
        def answer(part: TransferPart | None) -> None:
            done(NotSent("there is no such snapshot here") if part is None else part)

        if self.net.takes_stale(host):
            done(NotSent("keys have changed", is_stale=True))
            return
        age = (request.number, request.sequence)
        self.net.slaves[host].read_part(request.process, age, request.offset, 1000, answer)

    def expire(self, now: float) -> None:
        unanswered, self.net.unanswered = self.net.unanswered, []
        for end in unanswered:
            end()


class Net:
    """Slaves of several hosts with one loop.

    Attributes:
        hidden: hosts that discovery does not find.
        silent: hosts that do not answer.
        stale: host to the number of requests for which it wants another ticket.
        reports: reports to the master, by host.
    """

    def __init__(self, tmp_path, log) -> None:
        self.root, self.log = tmp_path, log
        self.posted: queue.Queue[Callable[[], None]] = queue.Queue()
        self.slaves: dict[str, ReplicationService] = {}
        self.wires: dict[str, Wire] = {}
        self.hidden: set[str] = set()
        self.silent: set[str] = set()
        self.stale: dict[str, int] = {}
        self.unanswered: list[Callable[[], None]] = []
        self.reports: dict[str, list] = {}
        self.now = clocks.boot_time()
        self.wait = KeepSettings().wait

    def add(self, name: str, **settings) -> ReplicationService:
        self.reports[name] = []
        wire = self.wires[name] = Wire(self, name)

        def publish(states) -> bool:
            self.reports[name].append(states)
            return True

        self.slaves[name] = ReplicationService(
            self.root / name, name, KeepSettings(**{"wait": self.wait, **settings}), wire,
            post=self.posted.put, publish=publish,
        )  # fmt: skip
        return self.slaves[name]

    def add_all(self, names: str) -> None:
        for name in names:
            self.add(name)

    def takes_stale(self, host: str) -> bool:
        self.stale[host] = self.stale.get(host, 0) - 1
        return self.stale[host] >= 0

    def replicate(self, *to: str, period: float = 1.0) -> None:
        """Add these hosts, and a, which sends replicas of `p` to them."""
        self.add_all("".join({"a", *to}))
        self.slaves["a"].keep(P7, to, period)

    def write(self, host: str, sequence: int, size: int = 10, number: int = 7) -> None:
        """Publish a snapshot of the node of `p`."""
        data = bytes([sequence % 256]) * size
        writer = SlotWriter(self.directory(host), "p", number)
        writer.write(sequence, [Block(data, zlib.crc32(data))])
        writer.close()

    def directory(self, host: str):
        return self.root / host / "p"

    def age(self, host: str) -> tuple[int, int] | None:
        head = reader.newest_head(self.directory(host))
        return None if head is None else head.age

    def until(self, condition: Callable[[], object], what: str, step: float = 0.1) -> None:
        """Let time pass, without real delays, until a condition holds."""
        deadline = clocks.boot_time() + PATIENCE
        while not condition():
            assert clocks.boot_time() < deadline, f"not in time: {what}"
            self.pass_time(step)

    def pass_time(self, seconds: float) -> None:
        self.now += seconds
        for slave in self.slaves.values():
            slave.tick(self.now)
        self.settle()

    def pass_times(self, count: int, step: float = 0.1) -> None:
        for _ in range(count):
            self.pass_time(step)

    def settle(self) -> None:
        """Deliver all results of the threads to the loop."""
        for slave in self.slaves.values():
            done = threading.Event()
            slave._jobs.put(done.set)
            assert done.wait(PATIENCE), "a thread is stuck"
        while not self.posted.empty():
            self.posted.get()()


@pytest.fixture
def net(tmp_path, caplog):
    caplog.set_level(logging.INFO)
    return Net(tmp_path, caplog)


def assignment(
    *snapshot_hosts: str, snapshots_from: int = 1, number: int = 9, **fields
) -> Assignment:
    spec = ProcessSpec("p", command=("x",), ros=True, migration=MigrationPolicy("handoff"))
    return Assignment(
        InstanceId("p", number), spec, 1, "p", snapshot_hosts=snapshot_hosts,
        snapshots_from=snapshots_from, **fields,
    )  # fmt: skip


# --- shipping ---------------------------------------------------------------------------------


def test_a_snapshot_is_sent_when_it_has_changed(net):
    """The replica is identical, and is not sent again before there is a newer snapshot."""
    net.replicate("b")
    net.write("a", 1, 600_000)
    net.until(lambda: net.age("b") == (7, 1), "the first state")
    assert reader.newest_content(net.directory("b")) == reader.newest_content(net.directory("a"))
    given = len(net.wires["a"].given)
    assert given == 3
    net.pass_times(50)
    assert len(net.wires["a"].given) == given
    net.write("a", 2, 600_000)
    net.until(lambda: net.age("b") == (7, 2), "the second state")


def test_snapshots_are_sent_at_most_as_often_as_the_policy_allows(net):
    """The bound holds however fast the snapshot changes."""
    net.replicate("b", period=2.0)
    for sequence in range(1, 101):
        net.write("a", sequence)
        net.pass_time(0.1)
    shipped = len({part.sequence for part in net.wires["a"].given})
    assert 4 <= shipped <= 6


def test_each_host_receives_a_replica(net):
    """Each host receives the replica, one after the other."""
    net.replicate("b", "c", "a")
    net.write("a", 5)
    net.until(lambda: net.age("b") == net.age("c") == (7, 5), "both copies")


def test_the_rate_is_bounded(net):
    """The bound holds for all transfers together; one second's amount may be sent at once."""
    net.add("a", max_rate=1_000_000).keep(P7, ["b"], 1.0)
    net.add("b")
    net.write("a", 1, 5_000_000)
    begun = net.now
    net.until(lambda: net.age("b") == (7, 1), "the state")
    assert 3.5 <= net.now - begun <= 6.0


def test_a_silent_host_is_tried_again_and_logged_once(net):
    """Other hosts still receive their replicas."""
    net.replicate("b", "c")
    net.silent.add("b")
    net.write("a", 1)
    net.until(lambda: net.age("c") == (7, 1), "the copy on c")
    net.pass_times(100)
    assert net.log.messages == ["b does not keep the state of p#7: no answer"]
    net.silent.clear()
    net.until(lambda: net.age("b") == (7, 1), "the copy on b")


@pytest.mark.parametrize(
    ("requests", "logged"), [(1, []), (3, ["b does not keep the state of p#7: keys have changed"])]
)
def test_a_changed_key_delays_a_replica_without_a_warning(net, requests, logged):
    """Each new or revoked key ends all tickets, and the next transfer has another one."""
    net.replicate("b")
    net.stale["b"] = requests
    net.write("a", 1)
    net.until(lambda: net.age("b") == (7, 1), "the copy on b")
    assert net.log.messages == logged


def test_a_newer_snapshot_on_the_other_host_is_left_alone(net):
    """An old instance that still runs somewhere does not replace newer state."""
    net.replicate("b")
    net.write("b", 1, number=8)
    net.write("a", 100)
    net.pass_times(20)
    assert net.age("b") == (8, 1)
    assert net.log.messages == []


def test_the_snapshot_of_a_successor_is_not_sent_back(net):
    """The process has moved to b, whose slave sends its replicas to this host."""
    net.replicate("b")
    net.write("a", 1)
    net.until(lambda: net.age("b") == (7, 1), "the first copy")
    given = len(net.wires["a"].given)
    net.write("b", 2, number=8)
    net.slaves["b"].keep(InstanceId("p", 8), ["a"], 1.0)
    net.until(lambda: net.age("a") == (8, 2), "the copy of the successor's state")
    net.pass_times(50)
    assert len(net.wires["a"].given) == given


def test_the_size_of_the_replicas_is_bounded(net):
    """The bound holds for the replicas of all processes together; existing ones stay."""
    net.add("a").keep(P7, ["b"], 1.0)
    net.add("b", max_bytes=10_000)
    net.write("a", 1, 9_000)
    net.until(lambda: net.age("b") == (7, 1), "the first state")
    net.write("a", 2, 20_000)
    net.until(lambda: net.log.messages, "a log line")
    assert "keep.max_bytes" in net.log.messages[0]
    assert net.age("b") == (7, 1)


def test_an_interrupted_transfer_takes_no_room(net):
    """The sender was lost after its first part; the replica of another process needs the room."""
    taker = net.add("b", max_bytes=10_000)
    answers = []
    taker.take_part(TransferPart("q", 3, 1, 0, 9_000, 0, b"x" * 50), answers.append)
    net.settle()
    assert answers == [None]
    net.pass_times(3)
    assert (net.root / "b" / "q" / "copy.new").exists()
    net.pass_time(60.0)
    assert not (net.root / "b" / "q").exists()
    taker.take_part(TransferPart("p", 7, 5, 0, 9_000, 0, b"x" * 50), answers.append)
    net.settle()
    assert answers == [None, None]


def test_a_snapshot_damaged_in_transfer_is_refused(net):
    """No part of the damaged replica is stored or left behind."""
    taker = net.add("b")
    net.write("b", 1, number=6)
    good = reader.newest_content(net.directory("b"))[1]
    answers = []
    part = TransferPart("p", 7, 5, 0, len(good), zlib.crc32(good), good[:-1] + b"?")
    taker.take_part(part, answers.append)
    net.settle()
    assert answers[0].code == "damaged"
    assert net.age("b") == (6, 1)
    assert not (net.directory("b") / "copy.new").exists()


def test_a_part_out_of_order_restarts_the_transfer(net):
    """A part was lost, or two senders send at the same time."""
    taker = net.add("b")
    answers = []
    taker.take_part(TransferPart("p", 7, 5, 100, 200, 0, b"x" * 50), answers.append)
    net.settle()
    assert answers[0].code == "order"


def test_parts_that_wait_for_a_slow_disk_are_bounded(net):
    """A stranger may send faster than the disk writes; the sender of a refused part tries again."""
    slave = net.add("a")
    free = threading.Event()
    slave._jobs.put(lambda: free.wait(PATIENCE))
    answers = []
    for number in range(100):
        part = TransferPart(f"p{number}", 7, 1, 100, 200, 0, bytes(50))
        slave.take_part(part, lambda refusal: answers.append(refusal.code))
    assert answers == ["full"] * 36
    free.set()
    net.settle()
    assert answers == ["full"] * 36 + ["order"] * 64
    slave.take_part(part, lambda refusal: answers.append(refusal.code))
    net.settle()
    assert answers[100:] == ["order"]


def test_a_slow_disk_does_not_block_the_loop(net, monkeypatch):
    """Files are written by a thread, not by the loop."""
    slave = net.add("a")
    net.write("a", 1)
    blocked, free = threading.Event(), threading.Event()

    def scan():
        blocked.set()
        free.wait(PATIENCE)
        return ()

    monkeypatch.setattr(slave._store, "scan", scan)
    slave.tick(net.now + 10.0)
    assert blocked.wait(PATIENCE)
    begun = clocks.boot_time()
    for number in range(100):
        slave.tick(net.now + 20.0 + number)
    assert clocks.boot_time() - begun < PATIENCE / 4
    free.set()
    net.settle()


# --- reports to the master --------------------------------------------------------------------


def test_a_change_of_the_replicas_is_reported_to_the_master(net):
    """A new master receives the report at once."""
    slave = net.add("a")
    net.pass_times(30)
    assert net.reports["a"] in ([], [()])
    net.write("a", 3)
    net.until(lambda: net.reports["a"] and net.reports["a"][-1], "a report")
    ((one,),) = [net.reports["a"][-1]]
    assert (one.instance, one.sequence) == (P7, 3)
    before = len(net.reports["a"])
    slave.report_again()
    assert len(net.reports["a"]) == before + 1


def test_a_received_replica_is_reported_at_once(net):
    """The report must not wait for the next look, because the process may be lost before."""
    net.replicate("b")
    net.pass_time(0.05)  # the look that follows its start is over
    net.write("a", 1)
    net.until(lambda: net.age("b") == (7, 1), "the copy", step=0.01)
    net.pass_times(3, 0.01)
    assert [(one.instance, one.sequence) for one in net.reports["b"][-1]] == [(P7, 1)]


def test_the_snapshot_of_a_running_process_is_not_deleted(net):
    """A late order does not delete the snapshot of a running process."""
    slave = net.add("a")
    net.write("a", 3)
    slave.drop(P7, lives=True)
    net.settle()
    assert net.age("a") == (7, 3)
    slave.drop(InstanceId("p", 6), lives=False)
    net.settle()
    assert net.age("a") == (7, 3)
    slave.drop(P7, lives=False)
    net.settle()
    assert not net.directory("a").exists()


# --- fetching ---------------------------------------------------------------------------------


def prepare(net: Net, host: str, request: Assignment) -> list[Assignment]:
    """Return the assignments that start, at once or after some time."""
    started: list[Assignment] = []
    if net.slaves[host].prepare(request, started.append):
        return [request]
    net.until(lambda: started, "the start")
    return started


def test_a_start_fetches_the_newest_snapshot(net):
    """The parts of the snapshot are stored as if the node had published it here."""
    net.add_all("ab")
    net.write("b", 42, 10_000)
    request = assignment("b")
    assert prepare(net, "a", request) == [request]
    assert net.age("a") == (7, 42)
    assert "was fetched from b for p#9" in net.log.messages[0]


def test_a_changed_key_makes_no_start_take_an_older_snapshot(net):
    """The same host is asked again, with another ticket."""
    net.add_all("abc")
    net.write("b", 42)
    net.write("c", 41)
    net.stale["b"] = 2
    prepare(net, "a", assignment("b", "c"))
    assert net.age("a") == (7, 42)


def test_the_next_host_is_asked_where_the_first_is_not_found(net, monkeypatch):
    net.wait = 0.05
    net.add_all("abc")
    net.write("b", 42)
    net.write("c", 41)
    net.hidden.add("b")
    prepare(net, "a", assignment("b", "c"))
    assert net.age("a") == (7, 41)


def test_without_a_newer_snapshot_a_process_starts_from_the_local_one(net, monkeypatch):
    """The slave logs the reason."""
    net.wait = 0.05
    net.add_all("ab")
    prepare(net, "a", assignment("b"))
    assert net.log.messages == [
        "no newer state for p#9, it starts from nothing: b: there is no such snapshot here"
    ]
    net.hidden.add("b")
    net.write("a", 5)
    prepare(net, "a", assignment("b"))
    second = net.log.messages[1]
    assert "it starts from cycle 5, which is here: b: its slave was not found" in second


def test_a_local_snapshot_as_new_is_not_fetched(net):
    net.add_all("ab")
    net.write("a", 42)
    net.write("b", 41)
    prepare(net, "a", assignment("b"))
    assert net.age("a") == (7, 42)


def test_a_snapshot_of_a_later_instance_is_not_fetched(net):
    """Its number is forged; the node would ignore it, and the one on the next host is true."""
    net.add_all("abc")
    net.write("b", 42, number=2**52)
    net.write("c", 41)
    prepare(net, "a", assignment("b", "c"))
    assert net.age("a") == (7, 41)


def test_snapshots_and_replicas_are_private_to_their_owner(net):
    """The mode is 0o700 under any umask, whether a node or a replica creates the directory."""
    before = os.umask(0)
    try:
        net.replicate("b")
        prepare(net, "a", assignment())
        net.write("a", 1)
        net.until(lambda: net.age("b") == (7, 1), "the copy")
    finally:
        os.umask(before)
    for host in "ab":
        assert stat.S_IMODE((net.root / host).stat().st_mode) == 0o700
        assert stat.S_IMODE(net.directory(host).stat().st_mode) == 0o700


@pytest.mark.parametrize(
    "needs_none", [assignment("a", "b"), assignment(), assignment("b", shadow=True)], ids=str
)
def test_a_start_that_needs_no_snapshot_of_another_host_fetches_none(net, needs_none):
    """The newest snapshot is here, or none exists, or the instance follows a source."""
    net.add_all("ab")
    net.write("a", 41)
    net.write("b", 42)
    prepare(net, "a", needs_none)
    assert net.age("a") == (7, 41)


def test_the_next_host_is_asked_if_the_replica_has_not_arrived_here(net):
    """The master names this host first, because the replica was on its way."""
    net.add_all("ab")
    net.write("b", 42)
    prepare(net, "a", assignment("a", "b"))
    assert net.age("a") == (7, 42)


def test_a_slave_that_is_found_late_still_provides_the_newest_snapshot(net):
    """Here is only the snapshot of an earlier instance, which ran on and has more cycles."""
    slave, started = net.add("a"), []
    net.add("b")
    net.write("a", 1006)
    net.write("b", 990, number=8)
    net.hidden.add("b")
    slave.prepare(assignment("b", "a"), started.append)
    net.pass_times(8, 1.0)
    assert not started
    net.hidden.clear()
    net.until(lambda: started, "the start")
    assert net.age("a") == (8, 990)


def test_a_slot_that_a_loss_of_power_has_torn_counts_for_no_start(net):
    """Its new header is on the disk, but not its content; a replica on another host is newer."""
    net.write("a", 3)
    net.write("b", 5)
    net.write("a", 6)
    torn = next(path for path, head in reader.snapshot_files(net.directory("a")))
    torn.write_bytes(torn.read_bytes().replace(b"\6" * 10, b"\1" * 10))
    net.add_all("ab")
    assert [one.sequence for one in net.slaves["a"].states()] == [3]
    assert "incomplete since a loss of power" in net.log.text
    prepare(net, "a", assignment("b", "a"))
    assert net.age("a") == (7, 5)


def test_a_stateless_process_starts_at_once(net):
    """No host is asked for a snapshot."""
    stateless = Assignment(P7, ProcessSpec("p", command=("x",)), 1, "p", snapshot_hosts=("b",))
    assert net.add("a").prepare(stateless, pytest.fail)


def test_snapshots_of_a_former_process_are_deleted_before_a_start(net):
    """The origin of these snapshots makes no difference."""
    net.add("a")
    net.write("a", 42)
    prepare(net, "a", assignment(snapshots_from=8))
    assert net.age("a") is None


def test_a_start_proceeds_though_the_search_for_its_snapshot_failed(net, monkeypatch):
    """The slave logs the error."""
    slave = net.add("a")
    monkeypatch.setattr(slave, "_look_for", lambda _: 1 / 0)
    prepare(net, "a", assignment())
    assert "ZeroDivisionError" in net.log.messages[0]


def test_a_start_that_is_called_off_does_not_happen(net):
    """The snapshot may arrive, but the instance does not start."""
    slave = net.add("a")
    net.add("b")
    net.write("b", 42, 10_000)
    request = assignment("b")
    assert not slave.prepare(request, lambda _: pytest.fail("it was started"))
    assert slave.is_preparing(request.instance)
    assert slave.forget(request.instance)
    net.pass_times(20)
    assert not slave.is_preparing(request.instance)


def test_a_fetch_that_is_called_off_disturbs_no_later_one(net, monkeypatch):
    """No further part is asked for; two fetches of one process refuse each other's parts."""
    slave, source = net.add("a"), net.add("b")
    net.write("b", 42, 10_000)
    asked: list[int] = []
    read_part = source.read_part
    monkeypatch.setattr(
        source, "read_part", lambda *part: (asked.append(part[2]), read_part(*part))
    )
    request = assignment("b")
    slave.prepare(request, lambda _: pytest.fail("it was started"))
    net.until(lambda: asked, "the first part")
    slave.forget(request.instance)
    before = list(asked)
    net.pass_times(20)
    assert asked == before
    assert prepare(net, "a", assignment("b", number=10))
    assert net.age("a") == (7, 42)


def test_a_snapshot_whose_reader_is_lost_leaves_the_memory(net):
    """A slave's memory is small, and a snapshot may have hundreds of megabytes."""
    source = net.add("b")
    net.write("b", 42, 10_000)
    answers = []
    source.read_part("p", (0, 0), 0, 1000, answers.append)
    net.settle()
    assert len(answers[0].data) == 1000
    assert source._store._being_read
    net.pass_time(60.0)
    assert not source._store._being_read
