"""`rosrm.node` on real DDS: faults inside a node; `test_handoff_protocol.py` has the protocol."""

from __future__ import annotations

import subprocess
import sys
from typing import Final

import pytest
from std_msgs.msg import Int64, String

from rosrm.node import Migratable
from rosrm.node.handoff import session, state_parts
from rosrm_msgs.msg import HandoffReport, StateConfig
from tests.ros.handoff_kit import fails, goes_on, is_gapless, numbers, shadowing
from tests.ros.nodes import (
    EPOCH,
    KEYS,
    PATIENCE,
    RELIABLE,
    Conductor,
    Counter,
    Stage,
    pair_of,
)

R, C = HandoffReport, StateConfig
#: Runs a test in a cluster with keys, and in one without security.
both = pytest.mark.parametrize("stage", [KEYS, None], indirect=True, ids=["keys", "open"])


@pytest.fixture
def pair(stage):
    """Return a counting source, its shadow, their received outputs, and a conductor."""
    counts, sums = stage.listen(Int64, "count"), stage.listen(Int64, "sum")
    pair = pair_of(stage, Counter)
    pair.counts, pair.sums = counts, sums
    stage.spin_until(lambda: counts, "the first count")
    return pair


# --- without faults ---------------------------------------------------------------------------


def test_the_next_handoff_may_begin_before_its_source_has_settled(stage, pair, monkeypatch):
    """A node reports ACTIVE some rounds before it is a source; no message in between is lost."""
    settle = []
    monkeypatch.setattr(
        pair.second._rosrm._destination, "_activated",
        lambda: settle.append(pair.second._rosrm._become_source),
    )  # fmt: skip
    pair.conductor.hand_over()
    stage.spin_until(lambda: settle, "the last step of the activation")
    stage.remove(pair.first)
    stage.instance(Counter, 3, alias="counter_1700000009", shadow=True)
    conductor = Conductor(stage, source=2, destination=3)
    conductor.say(C.SHADOW)
    conductor.wait(3, R.SHADOWING)
    goes_on(stage, pair.counts)
    settle.pop()()
    conductor.wait(3, R.READY)


#: A slave that reads the topic of a node, for its health check.
_READS: Final = """
import sys, time
from std_msgs.msg import Int64
from rosrm.model.ros_settings import RosSettings
from rosrm.ros.participant import Participant
slave = Participant(RosSettings(domain=int(sys.argv[1])), "rosrm_slave_h", pace="steady")
health = slave.unwatched_node("rosrm_slave_h_health")
reader = health.create_subscription(Int64, "/count", print, 10)
time.sleep(300.0)
"""


@pytest.mark.timeout(120)
def test_a_shadow_does_not_wait_for_the_reader_of_a_killed_slave(stage):
    """The slave stays in the source's graph for 120 s, and the shadow never discovers it."""
    counts = stage.listen(Int64, "count")
    source = stage.instance(Counter, 1)
    slave = subprocess.Popen([sys.executable, "-c", _READS, str(stage.domain)])
    try:
        stage.spin_until(
            lambda: source.output.get_subscription_count() == 2, "the reader of the slave"
        )
        graph = stage.plain.get_subscriptions_info_by_topic
        stage.spin_until(
            lambda: "rosrm_slave_h_health" in [one.node_name for one in graph("/count")],
            "the name of the slave",
        )
    finally:
        slave.kill()
        slave.wait()
    later = Stage(beside=stage)  # its participant has never discovered the slave
    later.instance(Counter, 2, alias="counter_1700000000", shadow=True)
    conductor = Conductor(stage, source=1, destination=2)
    conductor.hand_over()
    goes_on(stage, counts)
    assert source.output.get_subscription_count() == 2  # the reader of the slave is still there
    assert is_gapless(counts)


def test_a_shadow_waits_until_its_buffer_overlaps_the_state(stage, pair, monkeypatch):
    """A message between the source's state and the shadow's buffer would be lost."""
    talker = stage.plain.create_publisher(Int64, "add", RELIABLE)
    stage.plain.create_timer(0.02, lambda: talker.publish(Int64(data=1)))
    stage.spin_until(lambda: pair.sums, "a sum")
    with monkeypatch.context() as patch:
        patch.setattr(pair.second._rosrm.entities.buffer, "overlaps", lambda topic: False)
        shadowing(stage, pair, "until a message on /add has been here and in the state")
    pair.conductor.wait(2, R.READY)


def test_a_shadow_that_misses_an_input_does_not_become_active(stage, pair, monkeypatch):
    """The destination fails, and the source, which has the input, resumes."""
    pair.conductor.prepare()
    monkeypatch.setattr(pair.second._rosrm.entities.buffer, "misses_one", lambda topic: True)
    pair.conductor.say(C.SWITCH)
    report = pair.conductor.wait(2, R.FAILED)
    assert "a message on /add did not arrive here" in report.message
    pair.conductor.say(C.RESUME)
    pair.conductor.wait(1, R.RESUMED)
    goes_on(stage, pair.counts)


def test_an_input_that_comes_after_the_switch_and_was_processed_before_it_counts_once(stage, pair):
    """An input that reaches the successor after the state which covers it counts once."""
    talker = stage.plain.create_publisher(Int64, "add", RELIABLE)
    stage.spin_until(lambda: talker.get_subscription_count() == 2, "both inputs")
    late, received = [], pair.second._rosrm.entities._received
    pair.second._rosrm.entities._received = lambda *what: late.append(what)
    pair.second._rosrm.entities.catch_up = lambda: None
    talker.publish(Int64(data=1))
    stage.spin_until(lambda: pair.sums and late, "the sum, and the message at the shadow")
    pair.second._rosrm.entities.buffer.is_idle = lambda *what: True
    pair.conductor.hand_over()
    goes_on(stage, pair.counts)
    received(*late.pop())
    goes_on(stage, pair.counts)
    assert (pair.second.total, numbers(pair.sums)) == (1, [1])


# --- aborted ----------------------------------------------------------------------------------


@both
def test_what_an_earlier_handoff_ended_with_is_not_taken_for_the_end_of_this_one(stage, pair):
    """The last mark of an earlier handoff, or its key, is worth nothing to a later shadow."""
    pair.conductor.silence(pair.second)
    pair.conductor.resume()
    pair.conductor.say(C.DONE)
    stage.remove(pair.second)
    pair.first._rosrm._source._attach = lambda: None
    stage.instance(Counter, 3, alias="counter_18", shadow=True)
    later = Conductor(stage, source=1, destination=3)
    later.say(C.SHADOW)
    later.wait(3, R.SHADOWING)
    later.say(C.SWITCH)
    goes_on(stage, pair.counts, 100)
    assert R.ACTIVE not in later.of(3)
    assert is_gapless(pair.counts)


# --- bad input --------------------------------------------------------------------------------


def unreadable():
    """Raise an error with a path that is no UTF-8, which rclpy neither logs nor sends."""
    raise ValueError("cannot read map-\udcff.pgm")


@pytest.mark.parametrize(
    ("save", "text"),
    [
        (lambda: String(data="3"), "returned a String, not a std_msgs/msg/Int64"),
        (lambda: 1 // 0, "saving /counter/state raised ZeroDivisionError"),
        (unreadable, "saving /counter/state raised ValueError: cannot read map-?.pgm"),
    ],
    ids=["another class", "raises", "raises with a path that is no UTF-8"],
)
def test_a_wrong_save_function(stage, pair, save, text):
    """The source reports the failure, and keeps running."""
    pair.first._rosrm._parts[1]._save = save
    fails(stage, pair, text, of=1)


def test_a_state_that_is_too_large(stage, pair, monkeypatch):
    """The source refuses to send the state."""
    monkeypatch.setattr(state_parts, "LARGEST_PART", 4)
    fails(stage, pair, "bytes, more than the 4 that may travel", of=1)


def test_more_input_than_can_be_kept(stage, pair, monkeypatch):
    """The shadow gives up; the source loses nothing."""
    monkeypatch.setattr(pair.second._rosrm.entities.buffer, "_limit", 3)
    talker = stage.plain.create_publisher(Int64, "add", RELIABLE)
    stage.spin_until(lambda: talker.get_subscription_count() == 2, "both inputs")
    for _ in range(5):
        talker.publish(Int64(data=1))
    stage.spin_until(lambda: pair.second._rosrm._destination._ended, "the overflow")
    fails(stage, pair, "more came on /add than can be kept")
    stage.spin_until(lambda: numbers(pair.sums) == [1, 2, 3, 4, 5], "the source's sums")


@pytest.mark.parametrize("epoch", [2**64 - 1, EPOCH + 1001])
def test_a_message_of_an_epoch_that_stays_unknown_is_dropped(
    stage, pair, epoch, monkeypatch, capfd
):
    """The message is held for some seconds, and the flood of a stranger is bounded."""
    monkeypatch.setattr(session, "_EARLY_FOR", 0.3)
    for _ in range(100):
        pair.conductor.say(C.SHADOW, epoch=epoch)
    stage.spin_until(lambda: pair.first._rosrm._early, "a held message")
    assert len(pair.first._rosrm._early) <= 16
    stage.spin_until(lambda: pair.first._rosrm._early_timer is None, "the end of the patience")
    goes_on(stage, pair.counts)
    assert pair.conductor.reports == []
    assert f"it is of epoch {epoch}, which the slave" in capfd.readouterr().err
    pair.conductor.prepare()


def test_the_memory_for_refused_messages_is_bounded(stage, pair):
    """A stranger may send names of any length, each another one."""
    for number in range(100):
        pair.conductor.say(C.SHADOW, cluster=f"{number}" * 10_000)
    goes_on(stage, pair.counts, 20)
    for node in (pair.first, pair.second):
        refused = node._rosrm._refused
        assert len(refused) <= 16
        assert max(map(len, refused)) < 300


def test_async_callbacks_are_refused(stage):
    """An `async` callback is refused, because states are taken between two callbacks."""

    class Async(Counter):
        def __init__(self, **named):
            super().__init__(**named)
            self.create_timer(1.0, self.later)

        async def later(self):
            """Do nothing; never called."""

    with pytest.raises(TypeError, match="is `async`"):
        stage.instance(Async, 1)


def test_a_second_node_of_a_process_is_refused(stage):
    """A second node would answer for the first with its own state."""
    stage.instance(Counter, 1)
    with pytest.raises(
        RuntimeError, match="rosrm moves a process by one node, and 'counter' is it"
    ):
        stage.instance(Counter, 1)


def test_a_lifecycle_node_can_be_made_migratable(stage):
    """`Migratable` can precede any node class."""
    lifecycle = pytest.importorskip("rclpy.lifecycle")

    class Managed(Migratable, lifecycle.LifecycleNode):
        def __init__(self, **named):
            super().__init__("counter", **named)
            self.output = self.create_lifecycle_publisher(Int64, "count", RELIABLE)

    node = stage.instance(Managed, 1)
    heard = stage.listen(Int64, "count")
    stage.spin_until(lambda: node.output.get_subscription_count() == 1, "a listener")
    node.output.publish(Int64(data=1))
    node.trigger_configure()
    node.trigger_activate()
    node.output.publish(Int64(data=2))
    stage.spin_until(lambda: numbers(heard) == [2], "what was published when active", PATIENCE)


def test_a_node_that_shuts_ros_down_in_a_cycle_ends_in_order(stage, pair):
    """A job with a standby may end in this way; an error would make it a failed one."""
    pair.conductor.say(C.SHADOW)
    pair.conductor.wait(2, R.SHADOWING)
    source, entities = pair.first, pair.first._rosrm.entities
    stage.spin_until(lambda: source._rosrm._source._attached, "the successor")
    before = entities.sequence
    with entities.turn:
        entities._cycle(stage.context.shutdown)
    assert entities.sequence == before + 1


def test_a_fault_of_the_state_ends_no_cycle_before_the_shutdown_alone(stage, pair, monkeypatch):
    """While ROS runs, an error of rosrm itself is not hidden."""
    monkeypatch.setattr(pair.first._rosrm.entities, "on_cycle", lambda: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        stage.spin_until(lambda: False, "the error")
