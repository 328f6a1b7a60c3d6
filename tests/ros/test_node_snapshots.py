"""Restart of a node from its snapshot: order of the restore, and nothing processed twice."""

from __future__ import annotations

import gc
import time
import zlib
from contextlib import suppress
from select import select

import pytest
from rclpy.executors import MultiThreadedExecutor, SingleThreadedExecutor
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message, serialize_message
from std_msgs.msg import Int64
from std_srvs.srv import Trigger

from rosrm.component import link
from rosrm.node import Node
from rosrm.node.component_links import ComponentLinks
from rosrm.node.handoff.state_parts import ParametersPart, StateError
from rosrm.node.managed_node import Mode
from rosrm.node.migratable import _NODES
from rosrm.node.snapshots import restore, writer
from rosrm.node.snapshots.marks import POSITIONS
from rosrm.snapshots import reader
from rosrm.snapshots.format import Block, encoded_head
from rosrm.version import PROTOCOL_VERSION
from rosrm_msgs.msg import HandoffReport, StateMark
from tests.old_marks import old_mark
from tests.ros.nodes import ALIAS, RELIABLE, Conductor, Counter, Counting
from tests.unit.node.test_component_links import connected
from tests.waiting import wait_until

LATCHED = QoSProfile(
    depth=10, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL
)


class Busying(Counting):
    """A counter with a latched input, a service, a parameter and a cancelled timer."""

    def __init__(self, **named) -> None:
        super().__init__(**named)
        self.seen: list[int] = []
        self.declare_parameter("gain", 1.0)
        self.create_subscription(Int64, "settings", self.take, LATCHED)
        self.once = self.create_timer(0.01, self.run_once)
        self.runs = 0
        self.create_service(Trigger, "~/poke", self.poke)
        self.fails_at = 0

    def take(self, message: Int64) -> None:
        self.seen.append(message.data)
        self.total += message.data

    def run_once(self) -> None:
        self.runs += 1
        self.once.cancel()

    def poke(self, _request, response):
        response.message = str(self.count)
        return response

    def tick(self) -> None:
        super().tick()
        if self.count == self.fails_at:
            raise ValueError("the author's mistake")


class Busy(Busying, Node):
    """`Busying` as a node of `rosrm.node`."""


@pytest.fixture
def busy(implementation):
    """Return the class of a busy counter."""
    return type("Busy", (Busying, implementation), {})


def crash(stage, node) -> None:
    """Remove a node without a last snapshot."""
    node._rosrm._source._keeper._closed = True
    stage.remove(node)


def kept_up_to(directory, sequence: int) -> bool:
    head = reader.newest_head(directory)
    return head is not None and head.sequence >= sequence


def test_what_was_processed_is_not_processed_again(stage, tmp_path):
    """A latched message that the snapshot covers is not processed again after the restart."""
    talker = stage.plain.create_publisher(Int64, "settings", LATCHED)
    talker.publish(Int64(data=5))
    first = stage.instance(Busy, 1, keep=tmp_path)
    stage.spin_until(lambda: first.seen == [5], "the message")
    at = first._rosrm.entities.sequence
    stage.spin_until(lambda: kept_up_to(tmp_path, at), "a state that covers it")
    crash(stage, first)
    second = stage.instance(Busy, 1, keep=tmp_path)
    talker.publish(Int64(data=7))
    stage.spin_until(lambda: second.seen, "the next message")
    assert second.seen == [7]
    assert second.total == 12


def test_it_goes_on_as_it_was(stage, tmp_path, busy):
    """State, parameters, timers and services are restored before the first cycle."""
    first = stage.instance(busy, 1, keep=tmp_path)
    first.set_parameters([Parameter("gain", value=2.5)])
    stage.spin_until(lambda: first.count >= 20 and first.runs == 1, "twenty counts")
    stage.remove(first)  # a clean end, with a last snapshot
    counts = stage.listen(Int64, "count")
    second = stage.instance(busy, 2, keep=tmp_path)
    assert second.count == 0
    stage.spin_until(lambda: len(counts) >= 5, "further counts")
    assert [one.data for one in counts] == list(
        range(first.count + 1, first.count + 1 + len(counts))
    )
    assert second.get_parameter("gain").value == 2.5
    assert second.runs == 0
    assert second.once.is_canceled()
    client = stage.plain.create_client(Trigger, "/counter/poke")
    stage.spin_until(client.service_is_ready, "the service")


def test_the_state_in_the_middle_of_a_cycle_is_not_kept(stage, tmp_path, busy):
    """If a callback raises, the snapshot is from before the callback."""
    first = stage.instance(busy, 1, keep=tmp_path)
    stage.spin_until(lambda: first.count >= 5, "five counts")
    first.fails_at = first.count + 5
    with pytest.raises(ValueError, match="mistake"):
        stage.spin_until(lambda: False, "a fault")
    failed_at = first.count
    stage.remove(first)
    second = stage.instance(busy, 1, keep=tmp_path)
    stage.spin_until(lambda: second.count > 0, "a count")
    assert second.count <= failed_at


def test_a_revived_node_can_be_moved(stage, tmp_path, counter):
    """A restored node can be the source of a handoff; its successor saves its own snapshots."""
    first = stage.instance(counter, 1, keep=tmp_path / "a")
    stage.spin_until(lambda: first.count >= 10, "ten counts")
    stage.remove(first)
    counts = stage.listen(Int64, "count", RELIABLE)
    second = stage.instance(counter, 2, keep=tmp_path / "a")
    stage.spin_until(lambda: counts, "a count")
    shadow = stage.instance(
        counter, 3, alias="counter_1700000000", shadow=True, keep=tmp_path / "b"
    )
    conductor = Conductor(stage, source=2, destination=3)
    conductor.hand_over()
    conductor.wait(3, HandoffReport.ACTIVE)
    at = second.count
    stage.spin_until(lambda: shadow.count >= at + 5, "counts of the successor")
    stage.spin_until(lambda: kept_up_to(tmp_path / "b", 1), "its own kept state")
    assert reader.newest_head(tmp_path / "b").instance == 3
    assert [one.data for one in counts] == list(range(counts[0].data, counts[-1].data + 1))
    assert reader.newest_head(tmp_path / "a").instance == 2


def test_a_damaged_state_gives_way_to_the_one_before(stage, tmp_path):
    """A damaged snapshot costs one write; without any snapshot the node starts empty."""
    first = stage.instance(Counter, 1, keep=tmp_path)
    stage.spin_until(lambda: first.count >= 30, "thirty counts")
    stage.remove(first)
    (newest, head), (_, before) = reader.snapshot_files(tmp_path)
    newest.write_bytes(newest.read_bytes()[: head.size - 3])
    second = stage.instance(Counter, 1, keep=tmp_path)
    stage.spin_until(lambda: second.count > 0, "a count")
    assert second._rosrm.entities.sequence <= before.sequence + 1
    assert second.count >= before.sequence > 0
    crash(stage, second)
    for path, _ in reader.snapshot_files(tmp_path):
        path.write_bytes(b"nonsense")
    third = stage.instance(Counter, 1, keep=tmp_path)
    stage.spin_until(lambda: third.count > 0, "a count")
    assert third.count <= 2


def rewrite(directory, **changes) -> None:
    """Change the mark in the newest snapshot, as another release or a stranger would write it."""
    ((newest, head), *_) = reader.snapshot_files(directory)
    mark, *parts = reader.read(newest).blocks
    changed = deserialize_message(mark, StateMark)
    for name, value in changes.items():
        setattr(changed, name, value)
    is_old = changed.protocol_version < POSITIONS
    written = old_mark(changed) if is_old else bytes(serialize_message(changed))
    contents = [written, *parts]
    blocks = [Block(data, zlib.crc32(data)) for data in contents]
    header = encoded_head(head.process, head.instance, head.sequence + 1, blocks)
    newest.write_bytes(header + b"".join(contents))


def test_a_snapshot_of_an_earlier_release_is_restored(stage, tmp_path, counter):
    """Release 0.1.0 spoke protocol 5, and its marks had no positions and other digests."""
    first = stage.instance(counter, 1, keep=tmp_path)
    stage.spin_until(lambda: first.count >= 10, "ten counts")
    stage.remove(first)
    rewrite(tmp_path, protocol_version=5)
    second = stage.instance(counter, 2, keep=tmp_path)
    stage.spin_until(lambda: second.count > first.count, "the next count")


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"protocol_version": 4}, "it is of protocol version 4"),
        ({"protocol_version": PROTOCOL_VERSION + 1}, "it is of protocol version"),
        ({"sequence": 2**64 - 1}, "the impossible number"),
        ({"sequence": 2**62}, "the impossible number"),
    ],
    ids=str,
)
def test_a_snapshot_that_would_fail_later_is_not_restored(stage, tmp_path, counter, changes, text):
    first = stage.instance(counter, 1, keep=tmp_path)
    stage.spin_until(lambda: first.count >= 2, "two counts")
    stage.remove(first)
    rewrite(tmp_path, **changes)
    stage.instance(counter, 2, keep=tmp_path)
    with pytest.raises(Exception, match=text):
        stage.spin_until(lambda: False, "an error")


def test_a_state_without_a_cycle_is_not_kept(stage, tmp_path, counter):
    """The next constructor makes this state again; this constructor may have failed halfway."""
    stage.remove(stage.instance(counter, 1, keep=tmp_path))
    assert reader.newest_head(tmp_path) is None


def test_a_node_at_its_limit_of_threads_works_and_keeps_its_state_later(
    stage, tmp_path, monkeypatch
):  # fmt: skip
    """Otherwise the first cycle would end the node after each start."""

    def refused(*_, **__):
        raise RuntimeError("can't start new thread")

    with monkeypatch.context() as patch:
        patch.setattr(writer.threads, "start", refused)
        node = stage.instance(Counter, 1, keep=tmp_path)
        stage.spin_until(lambda: node.count >= 3, "three counts")
    stage.spin_until(lambda: kept_up_to(tmp_path, 3), "a kept state")


def test_parameters_in_a_snapshot_of_an_earlier_release_are_not_set_for_ever(
    stage, tmp_path, monkeypatch
):  # fmt: skip
    """Such a snapshot marks all parameters as set; those with equal values can change later."""

    def tuned(number, gain):
        overrides = [Parameter("gain", value=gain)]
        node = stage.instance(Busy, number, keep=tmp_path, parameter_overrides=overrides)
        stage.spin_until(lambda: node.count > 2 * number, "counts")
        stage.remove(node)
        return node.get_parameter("gain").value

    save = ParametersPart._all

    def all_set(part):
        part._set |= part._declared
        return save(part)

    with monkeypatch.context() as patch:
        patch.setattr(ParametersPart, "_all", all_set)
        assert tuned(1, 1.0) == 1.0
    assert [tuned(2, 1.0), tuned(3, 3.0)] == [1.0, 3.0]


class Refusing(Counter):
    """A counter that refuses each state."""

    def restore(self, _message: Int64) -> None:
        raise ValueError("too old")


@pytest.fixture
def refused(stage, tmp_path):
    """Return a directory with a snapshot."""
    first = stage.instance(Counter, 1, keep=tmp_path)
    stage.spin_until(lambda: first.count >= 2, "two counts")
    stage.remove(first)
    return tmp_path


def test_an_executor_of_several_threads_ends_with_a_failed_restore(stage, refused):
    """Otherwise the executor would report the error only after a further callback; none comes."""
    node = stage.instance(Refusing, 1, keep=refused)
    stage.executor.remove_node(node)
    executor = MultiThreadedExecutor(2, context=stage.context)
    executor.add_node(node)
    with pytest.raises(StateError, match="restoring /counter/state raised ValueError: too old"):
        wait_until(lambda: executor.spin_once(0.1), "the error")
    executor.shutdown()


def test_a_process_that_catches_the_error_of_a_failed_restore_is_ended(
    stage, refused, monkeypatch
):  # fmt: skip
    """Otherwise the process would look healthy, and neither work nor be restarted."""
    codes: list[int] = []
    monkeypatch.setattr(restore, "_END_PATIENCE", 0.0)
    monkeypatch.setattr(restore.os, "_exit", codes.append)
    stage.instance(Refusing, 1, keep=refused)

    def is_ended() -> bool:
        with suppress(StateError):
            stage.spin(0.1)
        return bool(codes)

    wait_until(is_ended, "the end")
    assert codes == [1]


def test_a_component_whose_snapshot_cannot_be_restored_ends_no_other(stage, refused):
    """The process reports why its component is not loaded; other components continue."""
    log, make = stage.plain.get_logger(), lambda *_: Refusing(context=stage.context)
    links = ComponentLinks(str(refused), stage.executor, make, log)
    with connected(str(refused)) as connection:
        environment = stage.environment("counter", 2, shadow=False, keep=refused)
        link.send(connection, {"environment": environment, "plugin": "", "arguments": []})
        stage.spin_until(lambda: select([connection], [], [], 0)[0], "the answer")
        answer = link.receive(connection)
    assert "restoring /counter/state raised ValueError: too old" in answer["fault"]
    assert links.nodes == []
    stage.spin(0.1)


class Unready(Node):
    """A node whose constructor raises before it has named its state."""

    def __init__(self, **named) -> None:
        super().__init__("counter", **named)
        raise OSError("no camera yet")


def test_a_node_that_cannot_be_made_is_freed(stage, tmp_path):
    """In a container, each attempt would leave one more node in the graph."""
    for _ in range(3):
        with pytest.raises(OSError, match="no camera yet"):
            stage.instance(Unready, 1, keep=tmp_path)
        gc.collect()
        assert not _NODES


def test_a_second_migratable_node_is_refused_each_time(stage, tmp_path):
    first = stage.instance(Counter, 1, keep=tmp_path)
    for _ in range(2):
        with pytest.raises(RuntimeError, match="'counter' is it already"):
            stage.instance(Counter, 1, keep=tmp_path)
    assert _NODES[1] is first


class Slow(Counter):
    """A counter that has no cycle but its input, and takes 50 ms to save."""

    def __init__(self, **named) -> None:
        super().__init__(period=1000.0, **named)

    def save(self) -> Int64:
        time.sleep(0.05)
        return super().save()


def test_what_is_not_kept_at_once_is_kept_though_no_cycle_follows(stage, tmp_path):
    """A state that takes long to save is saved less often, but within the maximum age."""
    talker = stage.plain.create_publisher(Int64, "add", LATCHED)
    node = stage.instance(Slow, 1, keep=tmp_path)
    for _ in range(5):
        talker.publish(Int64(data=1))
    stage.spin_until(lambda: node.total == 5, "five messages")
    writes = node._rosrm._source._keeper
    assert writes._kept < node._rosrm.entities.sequence
    stage.spin_until(lambda: kept_up_to(tmp_path, 5), "the last state")


def test_a_node_that_ends_before_its_timers_start_keeps_them(stage, tmp_path):
    """The next instance continues, although no cycle came between two restarts."""
    first = stage.instance(Counter, 1, keep=tmp_path)
    stage.spin_until(lambda: first.count >= 10, "ten counts")
    stage.remove(first)
    second = stage.instance(Counter, 2, keep=tmp_path)
    entities = second._rosrm.entities
    stage.spin_until(lambda: entities.mode is Mode.ACTIVE, "the restore")
    stage.remove(second)
    assert second.count == first.count
    third = stage.instance(Counter, 3, keep=tmp_path)
    stage.spin_until(lambda: third.count > first.count, "a further count")


class Asking(Counter):
    """A counter that spins in its constructor, before it has named its state."""

    def __init__(self, **named) -> None:
        self._held_back: list = []
        super().__init__(**named)
        executor = SingleThreadedExecutor(context=self.context)
        executor.add_node(self)
        for _ in range(20):
            executor.spin_once(timeout_sec=0.01)
        executor.remove_node(self)
        held_back, self._held_back = self._held_back, None
        for part in held_back:
            self.keep_state(*part)

    def keep_state(self, *part) -> None:
        if self._held_back is None:
            super().keep_state(*part)
        else:
            self._held_back.append(part)


def test_a_constructor_that_spins_is_waited_for(stage, tmp_path):
    """Nothing is restored and no cycle runs before all parts are named."""
    first = stage.instance(Counter, 1, keep=tmp_path)
    stage.spin_until(lambda: first.count >= 10, "ten counts")
    stage.remove(first)
    second = stage.instance(Asking, 1, keep=tmp_path)
    assert second.count == 0
    stage.spin_until(lambda: second.count > 0, "a count")
    assert second.count >= first.count


def test_who_is_followed_from_the_first_cycle_on_keeps_its_state_too(stage, tmp_path):
    """A snapshot also has the unchanged parts that were published before, e.g. parameters."""
    first = stage.instance(Counter, 1, keep=tmp_path)
    stage.instance(Counter, 2, alias=ALIAS, shadow=True)
    Conductor(stage, source=1, destination=2).prepare()
    at = first._rosrm.entities.sequence
    stage.spin_until(lambda: kept_up_to(tmp_path, at), "a kept state")


def test_once_there_is_room_again_every_state_is_kept_again(stage, tmp_path, counter):
    """After a full disk all snapshots are written again, not only the first."""
    directory = tmp_path / "state"
    directory.write_text("in the way")
    node = stage.instance(counter, 1, keep=directory)
    stage.spin_until(lambda: node.count >= 20, "twenty counts")
    directory.unlink()
    stage.spin_until(lambda: kept_up_to(directory, 20), "a first state")
    first = reader.newest_head(directory).sequence
    stage.spin_until(lambda: kept_up_to(directory, first + 50), "states of later cycles")


def test_the_last_state_is_written_once_there_is_room_though_no_cycle_follows(
    stage, tmp_path, implementation, monkeypatch
):
    monkeypatch.setattr(writer, "_RETRY", 0.1)
    directory = tmp_path / "state"
    directory.write_text("in the way")
    talker = stage.plain.create_publisher(Int64, "add", LATCHED)
    idle = type("Idle", (Counting, implementation), {})
    node = stage.instance(idle, 1, keep=directory, period=1000.0)
    talker.publish(Int64(data=1))
    stage.spin_until(lambda: node.total == 1, "the only cycle")
    stage.spin(0.2)
    directory.unlink()
    stage.spin_until(lambda: kept_up_to(directory, 1), "the state")
