"""Inputs around a handoff: a successor, or a source that resumes, processes the buffered ones."""

from __future__ import annotations

import threading
import time

import pytest
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup, ReentrantCallbackGroup
from rclpy.executors import MultiThreadedExecutor, SingleThreadedExecutor
from std_msgs.msg import Int64
from std_srvs.srv import Trigger

from rosrm.node import Node
from rosrm_msgs.msg import HandoffReport, StateConfig
from tests.ros.nodes import (
    ALIAS,
    RELIABLE,
    Conductor,
    Counter,
    Counting,
    Server,
    Serving,
    Stage,
    buffered,
    held_requests,
    pair_of,
)

R, C = HandoffReport, StateConfig


class Listening(Counting):
    """A counter that records messages on `in`, in order of arrival."""

    def __init__(self, group=None, work: float = 0.0, depth=RELIABLE, **named) -> None:
        super().__init__(**named)
        self.seen: list[int] = []
        self.work = work
        self.create_subscription(Int64, "in", self.take, depth, callback_group=group)

    def take(self, message: Int64) -> None:
        time.sleep(self.work)
        self.seen.append(message.data)


class Listener(Listening, Node):
    """`Listening` as a node of `rosrm.node`."""


@pytest.fixture
def hearer(implementation):
    """Return the class of a listener, of each implementation of the handoff protocol."""
    return type("Listener", (Listening, implementation), {})


class Threads:
    """Nodes spun beside the stage, by a multi-threaded executor unless given another."""

    def __init__(self, stage: Stage, executor=None) -> None:
        self._stage = stage
        self.executor = executor or MultiThreadedExecutor(num_threads=4, context=stage.context)
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._spin, daemon=True)
        self._nodes = []

    def _spin(self) -> None:
        while not self._over.is_set():
            self.executor.spin_once(timeout_sec=0.05)

    def take(self, node):
        """Take a node over from the stage."""
        self._stage.executor.remove_node(node)
        self._stage.nodes.remove(node)
        self._nodes.append(node)
        self.executor.add_node(node)
        if not self._thread.is_alive():
            self._thread.start()
        return node

    def end(self) -> None:
        self._over.set()
        self._thread.join(5.0)
        self.executor.shutdown(timeout_sec=5.0)
        for node in self._nodes:
            node.destroy_node()


@pytest.fixture
def threads(stage):
    threads = Threads(stage)
    yield threads
    threads.end()


class Talker:
    """A publisher of numbers on `in`, with an interval in seconds, in its own thread."""

    def __init__(self, stage: Stage, interval: float, readers: int) -> None:
        self.sent: list[int] = []
        self._interval = interval
        self._publisher = stage.plain.create_publisher(Int64, "in", RELIABLE)
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._talk, daemon=True)
        stage.spin_until(lambda: self._publisher.get_subscription_count() == readers, "the readers")

    def say(self, *numbers: int) -> None:
        for number in numbers:
            self.sent.append(number)
            self._publisher.publish(Int64(data=number))

    def has_arrived(self) -> bool:
        """Return True if the readers have all sent messages, whether processed or not."""
        return self._publisher.wait_for_all_acked()

    def _talk(self) -> None:
        while not self._end.wait(self._interval):
            self.say(len(self.sent))

    def __enter__(self):
        self._thread.start()
        return self

    def __exit__(self, *_) -> None:
        self.end()

    def end(self) -> None:
        self._end.set()
        self._thread.join(5.0)


# --- one thread -------------------------------------------------------------------------------


def test_a_silent_source_buffers_all_inputs(stage, hearer):
    """A source buffers all inputs while its destination exhausts timeouts and grace periods."""
    pair = pair_of(stage, hearer)
    talker = Talker(stage, 0.0, readers=2)
    pair.conductor.silence(pair.second)
    for number in range(3000):
        talker.say(number)
        stage.spin(0.0)
    pair.conductor.resume()
    stage.spin_until(lambda: len(pair.first.seen) >= 3000, "all that came")
    assert pair.first.seen == talker.sent


@pytest.mark.parametrize("end", ["resumed", "taken over"])
def test_an_input_whose_callback_raises_costs_that_input_alone(stage, end, hearer):
    """The author's exception is raised from the executor's spin, as in rclpy."""

    class Picky(hearer):
        def take(self, message):
            if message.data == 1:
                raise ValueError("bad input")
            super().take(message)

    pair = pair_of(stage, Picky)
    talker = Talker(stage, 0.0, readers=2)
    if end == "resumed":
        pair.conductor.silence(pair.second)
        successor = pair.first
    else:
        pair.conductor.prepare()
        stage.remove(pair.first)
        successor = pair.second
    talker.say(0, 1, 2, 3)
    stage.spin_until(lambda: buffered(successor) == 4, "four that are kept")

    def go_on():
        if end == "resumed":
            pair.conductor.resume()
        else:
            pair.conductor.say(C.TAKE_OVER)
            pair.conductor.wait(2, R.ACTIVE)
        processed()

    def processed():
        stage.spin_until(lambda: len(successor.seen) >= 3, "the others")

    with pytest.raises(ValueError, match="bad input"):  # from the executor's spin
        go_on()
    processed()
    assert successor.seen == [0, 2, 3]


def test_timers_and_services_run_despite_overload(stage, implementation):
    """Timers and services run despite overload, as in a node that was not migrated."""

    class Busy(Listening, Serving, implementation):
        pass

    there = Stage(beside=stage)  # with its own participant and thread
    stage._beside.clear()
    second = Threads(there, SingleThreadedExecutor(context=there.context))
    make = lambda **named: Busy(work=0.012, depth=10, **named)  # noqa: E731 - each in its context
    stage.instance(make, 1)
    shadow = there.instance(make, 2, alias=ALIAS, shadow=True)
    second.take(shadow)
    conductor = Conductor(stage, source=1, destination=2)
    client = stage.plain.create_client(Trigger, "/counter/poke")
    try:
        with Talker(stage, 0.010, readers=2):
            conductor.hand_over()
            before = shadow.count
            stage.spin_until(lambda: shadow.count > before + 10, "ticks of the successor")
            assert _answer(stage, client) == ALIAS
    finally:
        second.end()
        there.close()


def _answer(stage, client):
    """Call the service; repeat each second, because requests without a server are lost."""
    asked = []

    def is_answered():
        if not asked or time.monotonic() > asked[-1][0] + 1.0:
            asked.append((time.monotonic(), client.call_async(Trigger.Request())))
        return any(answer.done() for _, answer in asked)

    stage.spin_until(is_answered, "an answer")
    return next(answer.result().message for _, answer in asked if answer.done())


def test_two_inputs_of_one_topic_have_each_message_both(stage):
    """Both subscriptions get each message, even if the source falls silent between the two."""

    class Both(Listener):
        def __init__(self, **named):
            super().__init__(**named)
            self.also: list[int] = []
            self.create_subscription(Int64, "in", lambda m: self.also.append(m.data), RELIABLE)

    pair = pair_of(stage, Both)
    talker = Talker(stage, 0.0, readers=4)
    pair.conductor.prepare()
    member, source = pair.first._rosrm.entities, pair.first._rosrm._source
    received = member._received

    def receive(one, message, info):
        received(one, message, info)
        if not pair.first._rosrm._source._may_switch:
            source._may_switch = source._asked = source._finishing = True
            source._fall_silent()

    member._received = receive
    talker.say(0)
    pair.conductor.say(C.SWITCH)
    pair.conductor.wait(2, R.ACTIVE)
    stage.spin_until(
        lambda: pair.first.seen + pair.second.seen and pair.first.also + pair.second.also, "both"
    )
    assert pair.first.seen + pair.second.seen == [0]
    assert pair.first.also + pair.second.also == [0]


def test_a_source_processes_what_waits_before_it_falls_silent(stage):
    """A source processes waiting inputs, which a shadow that joined later never received."""
    pair = pair_of(stage, Listener)
    talker = Talker(stage, 0.0, readers=2)
    pair.conductor.prepare()
    talker.say(*range(50))
    assert talker.has_arrived(), "fifty in the readers"
    source = pair.first._rosrm._source
    source._may_switch = source._asked = True
    source._switch()
    pair.conductor.wait(1, R.SILENT)
    assert pair.first.seen == list(range(50))


def test_a_request_during_the_silence_is_answered_once(stage, server):
    """A buffered request is answered once, and blocks no thread."""
    pair = pair_of(stage, server)
    client = stage.plain.create_client(Trigger, "/counter/poke")
    stage.spin_until(client.service_is_ready, "the service")
    pair.conductor.silence(pair.second)
    answers = [client.call_async(Trigger.Request()) for _ in range(5)]
    stage.spin_until(lambda: held_requests(pair.first) == 5, "five requests that are held")
    assert pair.first.served == 0
    pair.conductor.resume()
    stage.spin_until(lambda: all(one.done() for one in answers), "the answers")
    assert {one.result().message for one in answers} == {"counter"}
    assert (pair.first.served, pair.second.served) == (5, 0)


# --- several threads --------------------------------------------------------------------------


def test_inputs_stay_in_order_with_several_threads(stage, threads):
    """Each input is processed once and in order, during and after the restore of a large state."""
    group = MutuallyExclusiveCallbackGroup

    class Slow(Listener):
        def __init__(self, **named):
            super().__init__(group(), work=0.006, period=0.2, **named)
            self.keep_state("~/more", Int64, lambda: Int64(data=len(self.seen)), self.restore_more)

        def restore_more(self, _message):
            time.sleep(0.03)

    pair = pair_of(stage, Slow)
    threads.take(pair.second)
    with Talker(stage, 0.01, readers=2) as talker:
        pair.conductor.hand_over()
        stage.spin_until(lambda: len(pair.second.seen) > 50, "fifty at the successor")
        talker.end()
        processed = lambda: pair.first.seen + pair.second.seen  # noqa: E731 - looked at twice
        stage.spin_until(lambda: len(processed()) >= len(talker.sent), "all that was sent")
    assert processed() == talker.sent
    assert R.FAILED not in pair.conductor.of(2)


def test_an_input_that_a_thread_holds_is_not_lost(stage, threads):
    """In a reentrant group a later input may overtake; the snapshot covers that input alone."""
    make = lambda **named: Listener(ReentrantCallbackGroup(), **named)  # noqa: E731 - two of them
    pair = pair_of(stage, make)
    threads.take(pair.first)
    talker = Talker(stage, 0.0, readers=2)
    gate, member = threading.Event(), pair.first._rosrm.entities
    received = member._received

    def receive(one, message, info):
        if message.data == 1:
            assert gate.wait(20.0)
        received(one, message, info)

    member._received = receive
    try:
        pair.conductor.prepare()
        talker.say(0, 1, 2)
        stage.spin_until(lambda: len(pair.first.seen) == 2, "two of three")
        pair.conductor.say(C.SWITCH)
        pair.conductor.wait(1, R.SILENT)
    finally:
        gate.set()
    pair.conductor.wait(2, R.ACTIVE)
    stage.spin_until(lambda: len(pair.first.seen + pair.second.seen) >= 3, "the third")
    assert sorted(pair.first.seen + pair.second.seen) == [0, 1, 2]


def test_buffered_requests_block_no_thread(stage, threads):
    """Buffered requests block no thread of a silent source."""
    pair = pair_of(stage, lambda **named: Server(ReentrantCallbackGroup(), **named))
    threads.take(pair.first)
    clients = [stage.plain.create_client(Trigger, "/counter/poke") for _ in range(8)]
    stage.spin_until(lambda: all(one.service_is_ready() for one in clients), "the service")
    pair.conductor.silence(pair.second)
    answers = [one.call_async(Trigger.Request()) for one in clients]
    pair.conductor.resume()
    stage.spin_until(lambda: all(one.done() for one in answers), "the answers")
    assert (pair.first.served, pair.second.served) == (8, 0)


def test_a_tick_that_a_thread_holds_is_not_skipped(stage, threads):
    """The successor executes the tick at once."""

    class Rare(Counter):
        def __init__(self, **named):
            super().__init__(**named)
            self.rares: list[float] = []
            group = MutuallyExclusiveCallbackGroup()
            self.rare = self.create_timer(
                3.0, lambda: self.rares.append(time.monotonic()), callback_group=group
            )

    pair = pair_of(stage, Rare)
    threads.take(pair.first)
    pair.conductor.prepare()
    source, member = pair.first._rosrm._source, pair.first._rosrm.entities
    rare = next(one for one in member.timers if one.timer is pair.first.rare)
    with member.turn:  # a cycle during which the slow timer comes due
        stage.spin_until(lambda: rare.taken, "a tick that waits for its turn")
        before = len(pair.first.rares)
        due = time.monotonic()
        source._may_switch = source._asked = source._finishing = True
        source._fall_silent()
    pair.conductor.say(C.SWITCH)
    pair.conductor.wait(2, R.ACTIVE)
    stage.spin_until(lambda: pair.second.rares, "the tick")
    assert len(pair.first.rares) == before
    assert pair.second.rares[0] - due < 2.5
