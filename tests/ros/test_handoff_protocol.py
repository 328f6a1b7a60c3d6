"""Cases of the handoff protocol on real DDS: each message sent, omitted or wrong.

They hold for `rosrm.node`, and for the C++ core of `rosrm_node_cpp` under an adapter in Python
(tests/cpp/cpp_node.py).
"""

from __future__ import annotations

import time
from functools import partial
from itertools import pairwise
from types import SimpleNamespace

import pytest
import rclpy
from rcl_interfaces.msg import ParameterDescriptor, SetParametersResult
from rclpy.duration import Duration
from rclpy.parameter import Parameter
from std_msgs.msg import Int64, String
from std_srvs.srv import Trigger

from rosrm.node import Node
from rosrm.node.handoff import source, stranded
from rosrm.ros.qos import latched
from rosrm.version import PROTOCOL_VERSION
from rosrm_msgs.msg import HandoffReport, StateConfig, StateMark, StatePart
from tests.cpp import cpp_node
from tests.ros.handoff_kit import fails, goes_on, is_gapless, numbers, shadowing
from tests.ros.nodes import (
    ALIAS,
    EPOCH,
    KEYS,
    PATIENCE,
    RELIABLE,
    Conductor,
    Counter,
    Counting,
    Server,
    Serving,
    Stage,
    buffered,
    pair_of,
    withhold,
)

R, C = HandoffReport, StateConfig
#: Runs a test in a cluster with keys, and in one without security.
both = pytest.mark.parametrize("stage", [KEYS, None], indirect=True, ids=["keys", "open"])


@pytest.fixture
def pair(stage, counter):
    """Return a counting source, its shadow, their received outputs, and a conductor."""
    counts, sums = stage.listen(Int64, "count"), stage.listen(Int64, "sum")
    pair = pair_of(stage, counter)
    pair.counts, pair.sums = counts, sums
    stage.spin_until(lambda: counts, "the first count")
    return pair


@both
def test_the_successor_goes_on_where_the_source_stopped(stage, pair):
    """The successor continues the count in order, without a gap or a repetition."""
    pair.conductor.hand_over()
    goes_on(stage, pair.counts)
    assert is_gapless(pair.counts)
    silent = pair.conductor.wait(1, R.SILENT)
    assert pair.conductor.wait(2, R.ACTIVE).sequence == silent.sequence


def test_a_node_succeeds_one_of_the_other_language(stage, counter, cpp_node_class):
    """Both implementations send and read the same messages, and restore the same parts."""
    counts = stage.listen(Int64, "count")
    stage.instance(counter, 1)
    stage.spin_until(lambda: counts, "the first count")
    in_cpp = type("Counter", (Counting, cpp_node_class), {})
    other = in_cpp if issubclass(counter, Node) else Counter
    stage.instance(other, 2, alias=ALIAS, shadow=True)
    Conductor(stage, source=1, destination=2).hand_over()
    goes_on(stage, counts)
    assert is_gapless(counts)


@pytest.mark.parametrize("publishers", [1, 3])
def test_every_input_is_processed_once(stage, pair, publishers):
    """Each input of a stream is processed once, throughout the handoff.

    Several publishers have unrelated clocks, and source and shadow differ in their progress.
    """
    talkers = [stage.plain.create_publisher(Int64, "add", RELIABLE) for _ in range(publishers)]
    sent = []

    def send():
        sent.append(1)
        talkers[len(sent) % publishers].publish(Int64(data=1))

    timer = stage.plain.create_timer(0.004, send)
    pair.conductor.hand_over()
    goes_on(stage, pair.sums, 50)
    pair.conductor.say(C.DONE)
    stage.remove(pair.first)
    stage.plain.destroy_timer(timer)
    stage.spin_until(lambda: numbers(pair.sums)[-1:] == [len(sent)], "the last sum")
    assert pair.second.total == len(sent)
    assert numbers(pair.sums) == list(range(pair.sums[0].data, len(sent) + 1))


def test_a_shadow_that_is_slower_than_its_source_keeps_up(stage, counter):
    """A slow shadow processes all waiting inputs at once; one by one it would fall behind."""
    busy = Stage(beside=stage)
    counts, sums = stage.listen(Int64, "count"), stage.listen(Int64, "sum")
    stage.instance(partial(counter, period=0.002), 1)
    talker = stage.plain.create_publisher(Int64, "add", RELIABLE)
    stage.plain.create_timer(0.002, lambda: talker.publish(Int64(data=1)))
    stage.spin_until(lambda: counts and sums, "the source's outputs")
    busy.instance(partial(counter, period=0.002), 2, alias=ALIAS, shadow=True)
    conductor = Conductor(stage, source=1, destination=2)

    def is_ready():
        for _ in range(12):  # callbacks of the other nodes per callback of the shadow
            stage.executor.spin_once(timeout_sec=0.0)
        return R.READY in conductor.of(2)

    conductor.say(C.SHADOW)
    stage.spin_until(is_ready, "a shadow that is ready")
    assert R.FAILED not in conductor.of(2)


@pytest.mark.parametrize("phase", [R.SHADOWING, R.READY], ids=["before", "after"])
def test_a_shadow_that_stalls_learns_which_inputs_the_missed_marks_covered(stage, counter, phase):
    """A restore of a large state takes longer than its reader can store the marks.

    The input has two publishers, so the newest covered message says nothing of the earlier ones.
    """
    busy = Stage(beside=stage)
    counts, sums = stage.listen(Int64, "count"), stage.listen(Int64, "sum")
    first = stage.instance(counter, 1)
    second = busy.instance(counter, 2, alias=ALIAS, shadow=True)
    talkers = [stage.plain.create_publisher(Int64, "add", RELIABLE) for _ in range(2)]
    conductor = Conductor(stage, source=1, destination=2)
    conductor.say(C.SHADOW)
    conductor.wait(1, R.ATTACHED)
    conductor.wait(2, phase)
    total = 700
    for number in range(total):
        talkers[number % 2].publish(Int64(data=1))
        while first.total < number:  # the shadow is not executed
            stage.executor.spin_once(timeout_sec=PATIENCE)
    conductor.hand_over()
    goes_on(stage, counts)
    stage.spin_until(lambda: numbers(sums)[-1:] == [total], "the last sum")
    goes_on(stage, counts)
    assert second.total == total
    assert numbers(sums) == list(range(1, total + 1))


def test_a_shadow_is_not_heard_before_it_is_active(stage, pair):
    """A shadow has no output, state, timer or service; with the same name it would be doubled."""
    pair.conductor.prepare()
    goes_on(stage, pair.counts, 20)
    assert pair.second.count <= pair.first.count
    assert is_gapless(pair.counts)
    assert stage.plain.count_publishers("/counter/state") == 1


def test_the_alias_changes_no_visible_name(stage, pair):
    """Private topics and parameter services keep their names under an alias."""
    pair.conductor.hand_over()
    stage.remove(pair.first)

    def names():
        return [name for name, _ in stage.plain.get_service_names_and_types()]

    Conductor(stage, source=2, destination=3).say(C.SHADOW)
    stage.spin_until(lambda: stage.plain.count_publishers("/counter/state") == 1, "its state topic")
    stage.spin_until(lambda: "/counter/set_parameters" in names(), "its parameter services")
    assert pair.second.get_name() == ALIAS
    assert not [name for name in names() if "1700000000" in name and "type_desc" not in name]


def test_parameters_set_at_run_time_move_along(stage, counter):
    """Parameters are set with their callbacks, even those declared late."""

    class Tuned(counter):
        def __init__(self, **named):
            super().__init__(**named)
            self.declare_parameter("gain", 1.0)
            self.gains = []
            self.add_on_set_parameters_callback(self.note)

        def note(self, parameters):
            self.gains += [one.value for one in parameters if one.name == "gain"]
            return rclpy.node.SetParametersResult(successful=True)

    first = stage.instance(Tuned, 1)
    first.set_parameters([Parameter("gain", value=2.5)])
    first.declare_parameter("late", "yes")
    second = stage.instance(Tuned, 2, alias="counter_17", shadow=True)
    conductor = Conductor(stage, source=1, destination=2)
    conductor.prepare()
    first.set_parameters([Parameter("gain", value=3.5)])
    conductor.hand_over()
    assert second.get_parameter("gain").value == 3.5
    assert second.get_parameter("late").value == "yes"
    assert second.gains[-1] == 3.5


def test_parameters_that_are_valid_only_together_move_along(stage, counter):
    """Interdependent parameters are set together; a read-only NaN (unequal to itself) is kept."""

    class Bounded(counter):
        def __init__(self, **named):
            super().__init__(**named)
            fixed = ParameterDescriptor(read_only=True)
            self.declare_parameter("unknown", float("nan"), fixed)
            self.declare_parameter("low", 0)
            self.declare_parameter("high", 5)
            self.add_on_set_parameters_callback(self.check)

        def check(self, parameters):
            values = {name: self.get_parameter(name).value for name in ("low", "high")}
            values.update({one.name: one.value for one in parameters})
            return SetParametersResult(successful=values["low"] <= values["high"])

    first = stage.instance(Bounded, 1)
    both = [Parameter("low", value=10), Parameter("high", value=20)]
    assert first.set_parameters_atomically(both).successful
    second = stage.instance(Bounded, 2, alias="counter_17", shadow=True)
    Conductor(stage, source=1, destination=2).hand_over()
    assert [second.get_parameter(name).value for name in ("low", "high")] == [10, 20]


def test_a_service_is_served_by_the_active_node_alone(stage, server):
    """In DDS all servers of a name get a request: a shadow has none, a silent node buffers."""
    pair = pair_of(stage, server)
    client = stage.plain.create_client(Trigger, "/counter/poke")

    def call():
        future = client.call_async(Trigger.Request())
        stage.spin_until(future.done, "an answer")
        return future.result().message

    pair.conductor.prepare()
    stage.spin_until(client.service_is_ready, "the service")
    assert [call() for _ in range(3)] == ["counter"] * 3
    assert _servers(stage, "/counter/poke") == ["counter"]
    pair.conductor.hand_over()
    stage.spin_until(lambda: _servers(stage, "/counter/poke") == [ALIAS], "the successor's service")
    assert [call() for _ in range(3)] == [ALIAS] * 3
    assert (pair.first.served, pair.second.served) == (3, 3)


def test_a_source_closes_its_services_one_by_one(stage, monkeypatch):
    """All at once would delay the first outputs of the successor. The author's come first."""
    monkeypatch.setattr(source, "_CLOSE_EVERY", 600.0)
    pair = pair_of(stage, Server)
    stage.spin_until(lambda: _servers(stage, "/counter/poke") == ["counter"], "the service")
    pair.conductor.hand_over()
    stage.spin_until(lambda: _servers(stage, "/counter/poke") == [ALIAS], "the successor's service")
    assert "counter" in _servers(stage, "/counter/get_parameters")


def test_a_source_in_cpp_closes_its_services_one_by_one(stage, cpp_node_class, monkeypatch):
    """Each service is closed in a callback of its own, because all peers process each closing."""
    wakes, closed = [], []
    wake, close = cpp_node._Core._wake, cpp_node._Service.close
    monkeypatch.setattr(cpp_node._Core, "_wake", lambda core: (wakes.append(core), wake(core)))
    monkeypatch.setattr(
        cpp_node._Service, "close", lambda service: (closed.append(len(wakes)), close(service))
    )
    pair_of(stage, type("Server", (Serving, cpp_node_class), {})).conductor.hand_over()
    stage.spin_until(lambda: len(closed) > 1, "two services closed")
    assert len(set(closed)) == len(closed)


def test_a_source_falls_silent_at_the_end_of_a_cycle(stage, counter, monkeypatch):
    """Then the time until its next input is longest, and the successor is active before it."""
    monkeypatch.setattr(source, "_CYCLE_PATIENCE", 600.0)
    wake = cpp_node._Core._wake
    monkeypatch.setattr(  # no alarm of a source in C++ rings
        cpp_node._Core, "_wake", lambda core: core._node.get_name() == "counter" or wake(core)
    )
    pair = pair_of(stage, partial(counter, period=600.0))
    talker = stage.plain.create_publisher(Int64, "add", RELIABLE)
    pair.conductor.prepare()
    pair.conductor.say(C.SWITCH)
    pair.conductor.wait(2, R.SWITCHING)
    stage.plain.create_timer(0.1, lambda: talker.publish(Int64(data=1)))
    pair.conductor.wait(1, R.SILENT)
    assert pair.first.total >= 1


def test_an_idle_source_falls_silent_without_a_cycle(stage, counter):
    """A node that waits for its inputs can be moved."""
    pair_of(stage, partial(counter, period=600.0)).conductor.hand_over()


def _servers(stage, name):
    """Return the nodes that serve a name, according to the graph."""
    return [
        node for node in ("counter", ALIAS)
        if name in dict(stage.plain.get_service_names_and_types_by_node(node, "/"))
    ]  # fmt: skip


def test_timers_go_on_in_step(stage, counter):
    """A slow timer of the successor keeps the schedule of the source's timer."""
    ticks = stage.listen(Int64, "count")
    times = []
    stage.plain.create_subscription(Int64, "count", lambda _: times.append(time.monotonic()), 10)
    pair = pair_of(stage, partial(counter, period=2.0))
    pair.conductor.hand_over()
    stage.remove(pair.first)
    done = len(ticks)
    stage.spin_until(lambda: len(times) >= done + 2, "two more ticks")
    assert numbers(ticks) == list(range(1, len(ticks) + 1))
    gaps = [later - earlier for earlier, later in pairwise(times)]
    assert all(1.0 < gap < 3.0 for gap in gaps), gaps
    assert pair.second.timer.timer_period_ns == 2_000_000_000


@both
def test_a_successor_can_be_succeeded(stage, pair, counter):
    """A second handoff under another alias continues the count."""
    pair.conductor.hand_over()
    pair.conductor.say(C.DONE)
    stage.remove(pair.first)
    third = stage.instance(counter, 3, alias="counter_1700000009", shadow=True)
    conductor = Conductor(stage, source=2, destination=3)
    conductor.hand_over()
    stage.remove(pair.second)
    goes_on(stage, pair.counts)
    assert is_gapless(pair.counts)
    assert third.count >= pair.counts[-1].data


def test_a_shadow_with_a_state_takes_over_before_it_is_ready(stage, pair, monkeypatch):
    """The shadow reports the sequence of its state, by which the master knows that it can."""
    monkeypatch.setattr(pair.second.output, "get_subscription_count", lambda: 0)
    pair.conductor.say(C.SHADOW)
    stage.spin_until(
        lambda: any(one.phase == R.SHADOWING and one.sequence for one in pair.conductor.reports),
        "a report of the state",
    )
    stage.remove(pair.first)
    pair.conductor.say(C.TAKE_OVER)
    pair.conductor.wait(2, R.ACTIVE)
    assert R.READY not in pair.conductor.of(2)
    goes_on(stage, pair.counts)
    assert is_gapless(pair.counts)


@pytest.mark.parametrize(
    ("what", "method", "text"),
    [
        ("output", "get_subscription_count", "for the readers of /count: 0 of 1 matched"),
        ("input", "get_publisher_count", "for the publishers of /add: 0 of 1 matched"),
    ],
)
def test_a_shadow_waits_until_it_is_matched_as_its_source_is(
    stage, pair, monkeypatch, what, method, text
):
    """A shadow waits for matched readers and inputs, because it would lose messages without."""
    talker = stage.plain.create_publisher(Int64, "add", RELIABLE)
    stage.spin_until(lambda: talker.get_subscription_count() == 2, "both inputs")
    subscriptions = {one.topic_name: one for one in pair.second.subscriptions}
    entity = pair.second.output if what == "output" else subscriptions["/add"]
    with monkeypatch.context() as patch:
        patch.setattr(entity, method, lambda: 0)
        shadowing(stage, pair, text)
    pair.conductor.wait(2, R.READY)


def stalled(stage, pair):
    """Stall a stream to the shadow after its first messages; return the function that ends it."""
    talker = stage.plain.create_publisher(Int64, "add", RELIABLE)
    stage.plain.create_timer(0.02, lambda: talker.publish(Int64(data=1)))
    stage.spin_until(lambda: pair.sums and buffered(pair.second), "an input of both nodes")
    return withhold(pair.second)


def test_a_shadow_waits_until_a_stalled_input_has_arrived(stage, pair):
    """Otherwise the successor would be stalled, although no message is lost."""
    release = stalled(stage, pair)
    pair.conductor.say(C.SHADOW)
    text = "until the newest message on /add in the state has been here"
    stage.spin_until(
        lambda: any(text in one.message for one in pair.conductor.reports), f"a wait {text}"
    )
    assert R.READY not in pair.conductor.of(2)
    release()
    pair.conductor.wait(2, R.READY)


def test_a_shadow_does_not_wait_for_ever_for_an_input_that_lags(stage, pair):
    """On a slow link each mark may be here before the messages that it covers."""
    stalled(stage, pair)
    pair.conductor.prepare()


def test_a_source_is_released_when_its_last_outputs_have_arrived(stage, pair, monkeypatch):
    """The source stays until its readers have acknowledged all, in order to send again."""
    with monkeypatch.context() as patch:
        patch.setattr(pair.first.output, "wait_for_all_acked", lambda timeout: False)
        pair.conductor.prepare()
        pair.conductor.say(C.SWITCH)
        pair.conductor.wait(2, R.ACTIVE)
        before = len(pair.counts)
        stage.spin_until(lambda: len(pair.counts) > before + 20, "counts of the successor")
        assert R.RELEASED not in pair.conductor.of(1)
    pair.conductor.wait(1, R.RELEASED)


def test_a_successor_does_not_take_over_from_a_source_that_still_speaks(stage, pair):
    """A destination waits while a source publishes, because its newer state still counts."""
    pair.conductor.prepare()
    pair.conductor.say(C.TAKE_OVER)
    before = len(pair.counts)
    stage.spin_until(lambda: len(pair.counts) > before + 30, "counts of the source")
    assert R.ACTIVE not in pair.conductor.of(2)
    stage.remove(pair.first)
    pair.conductor.wait(2, R.ACTIVE)


def test_an_opening_is_made_in_the_active_node_and_destroyed_in_the_silent_one(stage, counter):
    """Unique resources, such as an action server, exist in the active node only."""
    made = []

    class Opener(counter):
        def __init__(self, **named):
            super().__init__(**named)
            self.when_active(self.open)

        def open(self):
            made.append(("made", self.get_name()))
            return SimpleNamespace(destroy=lambda: made.append(("destroyed", self.get_name())))

    pair = pair_of(stage, Opener)
    assert made == [("made", "counter")]
    pair.conductor.hand_over()
    stage.spin_until(lambda: len(made) == 3, "what the successor makes")
    assert made[1:] == [("destroyed", "counter"), ("made", ALIAS)]


def test_a_successor_has_the_parameters_of_its_own_spec(stage, counter):
    """Only those set at run time move, also over two moves; otherwise `apply` changes nothing."""

    class Tuned(counter):
        def __init__(self, gain, **named):
            super().__init__(parameter_overrides=[Parameter("gain", value=gain)], **named)
            self.declare_parameter("gain", 0.5)
            self.declare_parameter("limit", 1)

    first = stage.instance(Tuned, 1, gain=1.0)
    first.set_parameters([Parameter("limit", value=7)])
    for number, gain in ((2, 2.0), (3, 3.0)):
        alias = f"counter_{number}"
        node = stage.instance(Tuned, number, alias=alias, shadow=True, gain=gain)
        Conductor(stage, source=number - 1, destination=number).hand_over()
        assert node.get_parameter("gain").value == gain
        assert node.get_parameter("limit").value == 7


def test_a_successor_whose_opening_fails_can_be_moved(stage):
    """The author may catch the error; the other openings and the role of a source follow."""
    made = []

    class Opener(Counter):
        def __init__(self, **named):
            super().__init__(**named)
            self.when_active(self.fail)
            self.when_active(lambda: made.append(self.get_name()))

        def fail(self):
            if self.get_name() == ALIAS:
                raise OSError("no such device")

    pair = pair_of(stage, Opener)

    def hand_over() -> None:
        pair.conductor.hand_over()
        stage.spin_until(lambda: False, "the error")

    with pytest.raises(OSError, match="no such device"):
        hand_over()
    stage.spin_until(lambda: made == ["counter", ALIAS], "the second opening")
    stage.remove(pair.first)
    stage.instance(Opener, 3, alias="counter_18", shadow=True)
    Conductor(stage, source=2, destination=3).prepare()


def test_inputs_are_served_between_two_services_that_open(stage, counter):
    """The node serves inputs between openings, because DDS takes some ms for each."""
    talker = stage.plain.create_publisher(Int64, "add", RELIABLE)
    totals = []

    class Opener(counter):
        def __init__(self, **named):
            super().__init__(**named)
            for _ in range(3):
                self.when_active(self.open)

        def open(self):
            totals.append((self.get_name(), self.total))
            talker.publish(Int64(data=1))
            assert talker.wait_for_all_acked(Duration(seconds=PATIENCE))

    first = stage.instance(Opener, 1)
    stage.spin_until(lambda: first.total == 3, "what was sent at its start")
    stage.instance(Opener, 2, alias="counter_17", shadow=True)
    Conductor(stage, source=1, destination=2).hand_over()
    stage.spin_until(lambda: len(totals) == 6, "what the successor opens")
    assert totals[3:] == [("counter_17", 3), ("counter_17", 4), ("counter_17", 5)]


@both
def test_a_source_that_resumes_has_lost_nothing(stage, pair):
    """A resumed source processes its buffered inputs; its timers and services continue."""
    talker = stage.plain.create_publisher(Int64, "add", RELIABLE)
    stage.spin_until(lambda: talker.get_subscription_count() == 2, "both inputs")
    pair.conductor.silence(pair.second)
    for _ in range(5):
        talker.publish(Int64(data=1))
    stage.spin_until(lambda: buffered(pair.first) == 5, "five kept messages")
    pair.conductor.resume()
    goes_on(stage, pair.counts)
    assert is_gapless(pair.counts)
    stage.spin_until(lambda: numbers(pair.sums) == [1, 2, 3, 4, 5], "the sums")


def test_a_shadow_that_was_called_off_never_becomes_active(stage, pair):
    """An aborted shadow ignores all later phases."""
    pair.conductor.prepare()
    pair.conductor.say(C.ABORT)
    pair.conductor.wait(2, R.ABORTED)
    pair.conductor.say(C.SWITCH)
    pair.conductor.say(C.TAKE_OVER)
    goes_on(stage, pair.counts, 20)
    assert R.ACTIVE not in pair.conductor.of(2)
    assert is_gapless(pair.counts)


def test_an_active_successor_cannot_be_called_off(stage, pair):
    """An active successor answers ABORT with ACTIVE, because there must be one owner."""
    pair.conductor.hand_over()
    pair.conductor.reports.clear()
    pair.conductor.say(C.ABORT)
    pair.conductor.wait(2, R.ACTIVE)
    goes_on(stage, pair.counts)


@pytest.fixture
def followed(stage, counter):
    """Return a source that a destination follows which does not run, and their conductor."""
    counts = stage.listen(Int64, "count")
    stage.instance(counter, 1)
    conductor = Conductor(stage, source=1, destination=2)
    conductor.say(C.SHADOW)
    conductor.report_as(2, R.SHADOWING)
    conductor.wait(1, R.ATTACHED)
    return SimpleNamespace(counts=counts, conductor=conductor)


def test_a_source_falls_silent_only_when_master_and_destination_both_want_it(stage, followed):
    """The request of the master alone does not silence the source; with the other one it does."""
    followed.conductor.say(C.SWITCH)
    goes_on(stage, followed.counts, 20)
    assert R.SILENT not in followed.conductor.of(1)
    followed.conductor.report_as(2, R.SWITCHING)
    followed.conductor.wait(1, R.SILENT)


@both
def test_the_last_state_is_enough_when_the_source_is_lost(stage, pair):
    """With the source gone, only the master's TAKE_OVER activates the destination."""
    pair.conductor.prepare()
    stage.remove(pair.first)
    pair.conductor.say(C.TAKE_OVER)
    pair.conductor.wait(2, R.ACTIVE)
    goes_on(stage, pair.counts)
    assert is_gapless(pair.counts)


@both
def test_a_part_that_did_not_change_goes_on_from_successor_to_successor(stage, counter):
    """A restored part that `save` reports as unchanged (None) still reaches the next successor."""

    class Mapper(counter):
        def __init__(self, **named):
            super().__init__(**named)
            self.map, self.changed = "empty", True
            self.keep_state("~/map", String, self.save_map, self.restore_map)

        def save_map(self):
            if not self.changed:
                return None
            self.changed = False
            return String(data=self.map)

        def restore_map(self, message):
            self.map, self.changed = message.data, False

    first = stage.instance(Mapper, 1)
    first.map = "drawn"
    second = stage.instance(Mapper, 2, alias="counter_17", shadow=True)
    conductor = Conductor(stage, source=1, destination=2)
    conductor.hand_over()
    conductor.say(C.DONE)
    stage.remove(first)
    conductor = Conductor(stage, source=2, destination=3)
    conductor.say(C.SHADOW)
    stage.spin_until(lambda: stage.plain.count_publishers("/counter/map"), "the part")
    third = stage.instance(Mapper, 3, alias="counter_18", shadow=True)
    conductor.hand_over()
    assert (second.map, third.map) == ("drawn", "drawn")


def test_a_part_that_a_shadow_names_late_is_followed(stage, counter):
    """A shadow may name a part until it receives a state that contains the part."""

    def name_another(node):
        node.keep_state("~/late", String, lambda: String(data="kept"), lambda message: None)
        return node

    shadow = stage.instance(counter, 2, alias="counter_17", shadow=True)
    conductor = Conductor(stage, source=1, destination=2)
    conductor.say(C.SHADOW)
    conductor.wait(2, R.SHADOWING)
    name_another(shadow)
    name_another(stage.instance(counter, 1))
    conductor.hand_over()


@pytest.fixture
def faulty(stage, counter):
    """Return a pair of counters that raise when `fault` is set."""

    class Faulty(counter):
        fault = None

        def save(self):
            self.raise_at("save")
            return super().save()

        def restore(self, message):
            self.raise_at("restore")
            super().restore(message)

        def raise_at(self, what):
            if self.fault == what:
                raise ValueError("no map " + "of it" * 100_000)

    counts = stage.listen(Int64, "count")
    pair = pair_of(stage, Faulty)
    pair.counts = counts
    return pair


def test_a_save_function_that_raises(stage, faulty):
    """The source reports the failure, and keeps running."""
    faulty.first.fault = "save"
    fails(stage, faulty, "saving /counter/state raised ValueError: no map", of=1)


def test_a_restore_function_that_raises(stage, faulty):
    """The failure is detected while the source is still active; then ABORT ends the handoff.

    A failed destination reports ABORTED, so that the source may resume without its end.
    """
    faulty.second.fault = "restore"
    fails(stage, faulty, "restoring /counter/state raised ValueError: no map")
    faulty.conductor.say(C.ABORT)
    faulty.conductor.wait(2, R.ABORTED)


def test_a_state_of_another_type(stage, pair, counter):
    """Source and destination must run the same program."""

    class Other(counter):
        def keep_state(self, topic, message_type, save, restore):
            super().keep_state(topic, String, String, lambda message: None)

    stage.remove(pair.second)
    pair.second = Stage(beside=stage).instance(Other, 2, alias="counter_17", shadow=True)
    text = "/counter/state is std_msgs/msg/Int64 at the source, and std_msgs/msg/String here"
    fails(stage, pair, text)


def test_a_state_topic_that_cannot_be_followed(stage, pair):
    """A topic with another type in the node itself is reported without a crash."""
    rclpy.node.Node.create_publisher(pair.second, Int64, "/counter/state", 1)
    fails(stage, pair, "/counter/state cannot be followed")


def test_a_state_topic_that_cannot_be_published(stage, pair):
    rclpy.node.Node.create_publisher(pair.first, Int64, "/counter/state", 1)
    fails(stage, pair, "/counter/state cannot be published", of=1)


def test_a_state_of_other_topics(stage, pair):
    """The error names the part that only one node has."""
    pair.second.keep_state("~/more", Int64, Int64, lambda message: None)
    fails(stage, pair, "/counter/more is none at the source, and std_msgs/msg/Int64 here")


def test_a_state_that_nobody_publishes_is_said_to_be_waited_for(stage, counter):
    """The shadow reports the wait, and the master's timeout ends it with this message."""
    stage.instance(counter, 2, alias="counter_17", shadow=True)
    conductor = Conductor(stage, source=1, destination=2)
    conductor.say(C.SHADOW)
    report = conductor.wait(2, R.SHADOWING)
    assert "waits for the source to answer" in report.message


def test_a_source_that_was_started_again_is_another_one(stage, pair, counter):
    """The state of a restarted source is another one, so the handoff fails."""
    pair.conductor.prepare()
    stage.remove(pair.first)
    stage.instance(counter, 1)
    report = pair.conductor.wait(2, R.FAILED)
    assert "the source was started again" in report.message


@pytest.mark.parametrize(
    ("wrong", "text"),
    [
        ({"cluster": "another"}, "it is of 'another', and 'rosrm' started this node"),
        ({"epoch": EPOCH - 1}, f"it is of epoch {EPOCH - 1}, and this is epoch {EPOCH}"),
        ({"protocol_version": 1}, "its protocol version is 1"),
        ({"channel": ""}, "it names no channel"),
        ({"channel": "/cmd_vel"}, "its channel is no topic of a handoff"),
        ({"channel": "/rosrm/handoff"}, "its channel is no topic of a handoff"),
    ],
)
def test_a_state_config_of_a_stranger_is_left_alone(stage, pair, wrong, text, capfd):
    """A foreign `state_config` has no effect but one line in the log, however often it comes."""
    for phase in (C.SHADOW, C.SWITCH, C.TAKE_OVER, C.SHADOW):
        pair.conductor.say(phase, **wrong)
    goes_on(stage, pair.counts, 20)
    assert pair.conductor.reports == []
    assert capfd.readouterr().err.count(text) == 2  # the source and the shadow, once each


def test_a_state_config_for_a_stranger_is_none_of_a_nodes_business(stage, pair, capfd):
    """A node ignores handoffs of other processes without a log line."""
    pair.conductor.say(C.SHADOW, process="other")
    pair.conductor.say(C.SWITCH, source=7, destination=8)
    goes_on(stage, pair.counts, 20)
    assert pair.conductor.reports == []
    assert "state_config" not in capfd.readouterr().err


def test_a_newer_epoch_fences_an_older_one(stage, pair):
    """Messages of a replaced master have no effect."""
    pair.conductor.say(C.SHADOW, epoch=EPOCH + 2)
    pair.conductor.wait(2, R.READY)
    pair.conductor.say(C.SWITCH, epoch=EPOCH + 1)
    goes_on(stage, pair.counts, 20)
    assert R.SILENT not in pair.conductor.of(1)


def test_an_older_epoch_is_followed_where_the_slave_is_registered_with_it(stage, tmp_path, counter):
    """An older copy of the journal was put back, so its master counts from there.

    Otherwise the node would refuse its only master until its own restart.
    """
    epoch = tmp_path / "epoch"
    epoch.write_text(f"{EPOCH - 2:020d}\n")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("ROSRM_EPOCH_FILE", str(epoch))
        pair = pair_of(stage, counter)
    counts = stage.listen(Int64, "count")
    for other in (EPOCH - 3, EPOCH - 1):
        pair.conductor.say(C.SHADOW, epoch=other)
    goes_on(stage, counts, 20)
    assert pair.conductor.reports == []
    pair.conductor.say(C.SHADOW, epoch=EPOCH - 2)
    pair.conductor.wait(2, R.READY)
    for other in (EPOCH - 3, EPOCH - 1, EPOCH):  # the last ones are of the lost runs
        pair.conductor.say(C.SWITCH, epoch=other)
    goes_on(stage, counts, 20)
    assert R.SILENT not in pair.conductor.of(1)


def test_an_epoch_that_the_slave_does_not_know_leaves_the_node_open_to_its_master(
    stage, tmp_path, counter
):
    """The slave notes the epoch of the master with which it is registered; a node goes no further.

    A node that believed a forged epoch would refuse all later messages of its master.
    """
    epoch = tmp_path / "epoch"
    epoch.write_text(f"{EPOCH + 2:020d}\n")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("ROSRM_EPOCH_FILE", str(epoch))
        pair = pair_of(stage, counter)
    counts = stage.listen(Int64, "count")
    pair.conductor.say(C.SHADOW, epoch=EPOCH + 3)
    pair.conductor.say(C.SHADOW, epoch=EPOCH + 1)
    pair.conductor.wait(2, R.READY)
    pair.conductor.say(C.SWITCH, epoch=EPOCH + 3)
    goes_on(stage, counts, 20)
    assert R.SILENT not in pair.conductor.of(1)
    epoch.write_text(f"{EPOCH + 3:020d}\n")  # the slave was slower than the message
    pair.conductor.wait(2, R.ACTIVE)


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"sequence": 2**64 - 1}, "the impossible number 18446744073709551615"),
        ({"sequence": 2**62}, "the impossible number"),
        ({"parts": [StatePart(topic="/counter/state", size=2**64 - 1)]}, "claims to have"),
    ],
    ids=["cycles", "many cycles", "a size"],
)
def test_a_mark_with_an_impossible_number_ends_the_handoff(stage, pair, change, text):
    """A node that took it over would fail at its next cycle; the source continues."""
    pair.conductor.prepare()
    run = pair.conductor.wait(1, R.ATTACHED).run
    marks = pair.conductor.topic(StateMark, "/counter/_rosrm/mark").publisher(
        stage.plain, latched(depth=100)
    )
    stage.spin_until(marks.entity.get_subscription_count, "the shadow")
    marks.publish(StateMark(protocol_version=PROTOCOL_VERSION, run=run, **change))
    assert text in pair.conductor.wait(2, R.FAILED).message
    goes_on(stage, pair.counts)


@pytest.fixture
def ask_soon(implementation, monkeypatch):
    """Let a silent source ask after 0.3 s."""
    monkeypatch.setattr(stranded, "ASK_EVERY", 0.3)
    monkeypatch.setattr(implementation, "ask_every", 0.3, raising=False)


def forge_silence(stage, destination=99):
    """Send the messages of a handoff that does not exist, as its master and its destination."""
    forged = Conductor(stage, source=1, destination=destination)
    forged.silence_alone()
    return forged


@both
def test_a_silent_source_asks_the_master_until_it_may_resume(stage, counter, ask_soon):
    """The answer is RESUME and DONE; inputs that came during the silence are served."""
    counts, sums = stage.listen(Int64, "count"), stage.listen(Int64, "sum")
    stage.instance(counter, 1)
    stage.spin_until(lambda: counts, "the first count")
    forged = forge_silence(stage)
    questions = forged.questions()
    talker = stage.plain.create_publisher(Int64, "add", RELIABLE)
    stage.spin_until(talker.get_subscription_count, "the input")
    talker.publish(Int64(data=1))
    stage.spin_until(lambda: len(questions) >= 3, "questions")
    question = questions[0]
    assert (question.instance, question.destination, question.phase) == (1, 99, R.SILENT)
    for phase in (C.RESUME, C.DONE):
        forged.say(phase, channel="/rosrm/handoff/as_the_master_names_it_99")
    goes_on(stage, counts)
    stage.spin_until(lambda: numbers(sums) == [1], "the sum")
    assert is_gapless(counts)
    asked = len(questions)
    goes_on(stage, counts, 50)
    assert len(questions) == asked
    assert stage.plain.count_publishers("/rosrm/handoff/stranded") == 0


def test_a_forged_end_of_the_handoff_does_not_stop_the_questions(stage, counter, ask_soon):
    stage.instance(counter, 1)
    forged = forge_silence(stage)
    forged.say(C.DONE)
    questions = forged.questions()
    stage.spin_until(lambda: len(questions) >= 2, "questions")


def test_reports_of_instances_that_are_not_part_of_the_handoff_have_no_effect(stage, followed):
    """Only the destination that the master names can ask the source for silence."""
    followed.conductor.say(C.SWITCH)
    for instance, destination in ((7, 2), (2, 7), (1, 2), (0, 2), (2**64 - 1, 2)):
        followed.conductor.report_as(instance, R.SWITCHING, destination=destination)
    goes_on(stage, followed.counts, 30)
    assert R.SILENT not in followed.conductor.of(1)


def test_a_state_topic_is_named_once(stage, counter):
    """Two parts cannot share a topic."""
    node = stage.instance(counter, 1)
    with pytest.raises((ValueError, RuntimeError), match="/counter/state is named twice"):
        node.keep_state("/counter/state", Int64, Int64, print)


def test_without_rosrm_it_is_rclpys_node(stage, counter):
    """The node has no additional topics, callbacks or objects."""
    ours = stage.add(counter(context=stage.context))
    talker = stage.plain.create_publisher(Int64, "add", RELIABLE)
    sums = stage.listen(Int64, "sum")
    stage.spin_until(lambda: talker.get_subscription_count() == 1, "its input")
    talker.publish(Int64(data=2))
    stage.spin_until(lambda: numbers(sums) == [2], "its output")
    assert type(ours.output) is rclpy.publisher.Publisher
    topics = [name for name, _ in stage.plain.get_topic_names_and_types()]
    assert not [name for name in topics if "rosrm" in name or name.startswith("/counter/")]
