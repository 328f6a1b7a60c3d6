"""Buffer of inputs for a successor: no message is lost or processed twice."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from functools import partial
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rosrm.node.entities import NEWEST
from rosrm.node.handoff.buffer import HISTORY, InputBuffer, Known, Sent
from tests.cpp.core_parts import CppInputBuffer

A, B = "/a", "/b"
ROOM = 1000


#: Creates a buffer from its limit, room and time.
Make = Callable[[int, int, float], Any]


@pytest.fixture(scope="module", params=["Python", "C++"])
def make(request) -> Make:
    """Return each implementation of the buffer: of `rosrm.node`, and of `rosrm_node_cpp`."""
    if request.param == "Python":
        return InputBuffer
    return partial(CppInputBuffer, request.getfixturevalue("cpp_core"))


def drained(buffer):
    return [(kept.topic, kept.stamp) for kept in iter(buffer.take, None)]


def cover(buffer, topic, stamps, *, single, now, processed=None):
    """Cover messages; by default these are all that the source has processed."""
    if processed is None:
        processed = len(stamps)
    buffer.cover(topic, stamps, processed=processed, single=single, now=now)


def filled(make, *messages, limit=100):
    buffer = make(limit, ROOM, 0.0)
    for topic, stamp in messages:
        assert buffer.add(topic, Sent(stamp), None, 0.0)
    return buffer


def test_messages_come_out_in_the_order_in_which_they_came_in(make):
    """The order holds across inputs, too."""
    messages = [(A, 3), (B, 9), (A, 4), (B, 10)]
    assert drained(filled(make, *messages)) == messages


def test_what_a_state_covers_is_dropped(make):
    """The rest stays, in order."""
    buffer = filled(make, (A, 1), (B, 1), (A, 2), (A, 3))
    cover(buffer, A, [1, 2], single=True, now=0.0)
    assert drained(buffer) == [(B, 1), (A, 3)]


def test_a_message_may_come_after_the_state_that_covers_it(make):
    """Marks and inputs arrive on different topics."""
    buffer = filled(make)
    cover(buffer, A, [5], single=False, now=0.0)
    assert buffer.add(A, Sent(5), None, 0.0)
    assert buffer.add(A, Sent(6), None, 0.0)
    assert drained(buffer) == [(A, 6)]


def test_older_messages_of_a_covered_publisher_are_skipped(make):
    """The source never had it, and a late process would break the order."""
    buffer = filled(make, (A, 1), (A, 2), (A, 3))
    cover(buffer, A, [2], single=True, now=0.0)
    assert drained(buffer) == [(A, 3)]


def test_the_clocks_of_several_publishers_are_not_compared(make):
    """A robot's clock that is behind does not make its messages covered."""
    buffer = filled(make, (A, 1000), (A, 3))
    cover(buffer, A, [1000], single=False, now=0.0)
    assert drained(buffer) == [(A, 3)]


def test_a_publisher_that_moves_to_a_clock_behind_is_not_taken_for_covered(make):
    """Both the publisher's time stamps and those processed by the source show the change."""
    buffer = filled(make, (A, 1000))
    cover(buffer, A, [1000], single=True, now=0.0)
    assert buffer.add(A, Sent(3), None, 0.0)
    assert drained(buffer) == [(A, 3)]
    buffer = filled(make)
    cover(buffer, A, [1000, 3], single=True, now=0.0)
    assert buffer.add(A, Sent(4), None, 0.0)
    assert drained(buffer) == [(A, 4)]


def test_a_publisher_that_is_alone_again_is_not_measured_by_one_that_left(make):
    """The clock of the publisher that left may have been ahead."""
    buffer = filled(make)
    cover(buffer, A, [10, 1000], single=False, now=0.0)
    cover(buffer, A, [11], single=True, now=0.0)
    assert buffer.add(A, Sent(12), None, 0.0)
    assert drained(buffer) == [(A, 12)]


def test_a_message_that_did_not_come_is_missed_until_a_state_covers_it(make):
    """The sequence numbers of its publisher show the gap."""
    buffer = make(10, ROOM, 0.0)
    for stamp, number in ((10, 1), (20, 2), (40, 4)):
        assert not buffer.misses_one(A)
        buffer.add(A, Sent(stamp, number), None, 0.0)
    assert buffer.misses_one(A)
    assert not buffer.misses_one(B)
    cover(buffer, A, [10, 20, 30], single=True, now=0.0)
    assert buffer.misses_one(A)  # 40 may be the second missing message
    cover(buffer, A, [40], single=True, now=0.0)
    assert not buffer.misses_one(A)


def test_a_message_of_one_of_several_publishers_that_did_not_come_is_missed(make):
    """Each publisher has its own numbers, and its messages are covered in their order."""
    buffer = make(10, ROOM, 0.0)
    for stamp, number in ((11, 1), (70, 8), (12, 2), (71, 9)):
        buffer.add(A, Sent(stamp, number), None, 0.0)
    cover(buffer, A, [11, 70, 12], single=False, now=0.0)
    assert not buffer.misses_one(A)
    for stamp, number in ((14, 4), (72, 10)):
        buffer.add(A, Sent(stamp, number), None, 0.0)
    cover(buffer, A, [11, 70, 12, 71, 72], single=False, now=0.0)
    assert buffer.misses_one(A)
    cover(buffer, A, [11, 70, 12, 71, 72, 13, 14], single=False, now=0.0)
    assert not buffer.misses_one(A)


def test_a_publisher_that_was_restarted_has_lost_nothing(make):
    """The numbers of a restarted publisher begin at 1 again, which is no loss."""
    buffer = make(10, ROOM, 0.0)
    for stamp, number in ((10, 7), (20, 8), (30, 1)):
        buffer.add(B, Sent(stamp, number), None, 0.0)
    assert not buffer.misses_one(B)


def test_the_numbers_that_several_threads_have_taken_show_no_loss(make):
    """Messages that several threads take arrive in any order, so a gap is no loss."""
    buffer = make(10, ROOM, 0.0)
    buffer.mix(A)
    for stamp, number in ((10, 1), (30, 3), (20, 2)):
        buffer.add(A, Sent(stamp, number), None, 0.0)
    assert not buffer.misses_one(A)


def test_a_full_reader_may_have_dropped_a_message_of_one_of_several_publishers(make):
    """Its publisher may send no further one whose number shows it, so all those kept must count."""
    buffer = filled(make, (A, 1), (A, 2), (B, 1))
    buffer.overran(A)
    buffer.overran(B)
    assert not buffer.misses_one(A)
    cover(buffer, A, [1], single=False, now=0.0)
    assert buffer.misses_one(A)
    assert not buffer.misses_one(B)
    cover(buffer, A, [1, 2], single=False, now=0.0)
    assert not buffer.misses_one(A)


def test_a_reader_that_was_full_during_the_switch_fails_it(make):
    """The silent source no longer processes a message that the destination has lost."""
    buffer = filled(make, (A, 1))
    cover(buffer, A, [1], single=False, now=0.0)
    buffer.is_last = True
    buffer.overran(A)
    assert buffer.misses_one(A)


def test_marks_that_did_not_come_are_noticed_until_a_whole_one_names_what_they_covered(make):
    """The source and the destination would both process the messages that only these named."""
    buffer = make(1000, ROOM, 0.0)
    for stamp in range(1, 601):
        buffer.add(A, Sent(stamp), None, 0.0)
    assert buffer.known(A) is Known.ALL
    cover(buffer, A, [1, 2], single=False, now=0.0)
    assert buffer.known(A) is Known.ALL
    cover(buffer, A, range(301, 557), processed=556, single=False, now=0.0)
    assert buffer.known(A) is Known.GAP
    cover(buffer, A, range(302, 558), processed=557, single=False, now=0.0)
    assert buffer.known(A) is Known.GAP
    cover(buffer, A, range(1, 558), single=False, now=0.0)
    assert buffer.known(A) is Known.ALL
    assert drained(buffer) == [(A, stamp) for stamp in range(558, 601)]


def test_a_stall_of_the_destination_lets_no_message_be_processed_twice(make):
    """While it restores a large state, its reader drops marks of an input with two publishers."""
    buffer = make(100_000, 1 << 30, 0.0)
    history, marks, waiting = deque(maxlen=HISTORY), deque(maxlen=100), []
    is_whole = True
    for stamp in range(2000):
        history.append(stamp)
        waiting.append(stamp)
        marks.append((list(history)[0 if is_whole else -NEWEST :], stamp + 1))
        is_whole = False
        if 500 <= stamp < 1100:
            continue  # the stall
        for one in waiting:
            buffer.add(A, Sent(one), None, 0.0)
        waiting.clear()
        while marks:
            stamps, processed = marks.popleft()
            cover(buffer, A, stamps, processed=processed, single=False, now=0.0)
        is_whole = buffer.known(A) is Known.GAP  # the source answers with its whole history
        assert is_whole is (stamp == 1100)
    assert drained(buffer) == []


def test_a_gap_does_not_matter_with_one_publisher(make):
    """All messages before the newest covered one were processed or skipped."""
    buffer = filled(make, (A, 1), (A, 2), (A, 3))
    cover(buffer, A, [1], single=True, now=0.0)
    cover(buffer, A, [3], processed=3, single=True, now=0.0)
    assert buffer.known(A) is Known.ALL
    assert drained(buffer) == []


def test_a_gap_that_the_source_has_forgotten_is_for_ever(make):
    """The source remembers its newest processed messages."""
    buffer = filled(make, (A, 1))
    cover(buffer, A, [1], single=False, now=0.0)
    cover(buffer, A, [2], processed=1 + HISTORY, single=False, now=0.0)
    assert buffer.known(A) is Known.GAP
    cover(buffer, A, [3], processed=2 + HISTORY, single=False, now=0.0)
    assert buffer.known(A) is Known.LOST


def test_a_message_from_before_the_first_mark_is_doubtful_until_a_mark_names_it(make):
    """The source may have processed it so long ago that no mark names it."""
    buffer = filled(make, (A, 5), (A, 99_999))
    history, processed = list(range(10_000, 10_000 + HISTORY)), 50_000
    cover(buffer, A, history[-256:], processed=processed, single=False, now=0.0)
    assert buffer.known(A) is Known.GAP
    cover(buffer, A, history, processed=processed, single=False, now=0.0)
    assert buffer.known(A) is Known.GAP
    assert buffer.add(A, Sent(100_000), None, 0.0)
    cover(buffer, A, [*history[-100:], 5], processed=processed + 1, single=False, now=0.0)
    assert buffer.known(A) is Known.GAP
    cover(buffer, A, [5, 99_999], processed=processed + 2, single=False, now=0.0)
    assert buffer.known(A) is Known.ALL
    assert drained(buffer) == [(A, 100_000)]


def test_the_buffer_is_bounded_for_each_input(make):
    """A flood on one input does not push out another's messages."""
    buffer = filled(make, (A, 1), (A, 2), limit=2)
    assert not buffer.add(A, Sent(3), None, 0.0)
    assert buffer.add(B, Sent(3), None, 0.0)
    cover(buffer, A, [1], single=True, now=0.0)
    assert buffer.add(A, Sent(3), None, 0.0)
    assert drained(buffer) == [(A, 2), (B, 3), (A, 3)]


def test_an_input_overlaps_once_a_message_was_here_and_in_the_state(make):
    """The order of the two makes no difference."""
    buffer = filled(make, (A, 5))
    cover(buffer, A, [4], single=True, now=0.0)
    assert not buffer.overlaps(A)
    cover(buffer, A, [5], single=True, now=0.0)
    assert buffer.overlaps(A)
    cover(buffer, B, [7], single=True, now=0.0)
    assert not buffer.overlaps(B)
    buffer.add(B, Sent(7), None, 0.0)
    assert buffer.overlaps(B)


def test_an_input_is_behind_until_the_newest_covered_message_arrives(make):
    """After a lost message a reliable reader may receive nothing more for seconds."""
    buffer = make(10, ROOM, 0.0)
    assert not buffer.is_behind(A)
    cover(buffer, A, [1], single=True, now=0.0)
    assert buffer.is_behind(A)
    buffer.add(A, Sent(1), None, 0.0)
    assert not buffer.is_behind(A)
    cover(buffer, A, [1, 2, 3], single=True, now=0.0)
    assert buffer.overlaps(A)
    assert buffer.is_behind(A)
    buffer.add(A, Sent(2), None, 0.0)
    assert buffer.is_behind(A)
    buffer.add(A, Sent(4), None, 0.0)
    assert not buffer.is_behind(A)


def test_an_input_of_several_publishers_is_not_behind(make):
    """Their clocks cannot be compared, nor can that of a publisher that moved to another clock."""
    buffer = filled(make, (A, 1), (B, 1000))
    cover(buffer, A, [1, 1000], single=False, now=0.0)
    assert not buffer.is_behind(A)
    cover(buffer, B, [1000, 1001], single=True, now=0.0)
    assert buffer.is_behind(B)
    buffer.add(B, Sent(3), None, 0.0)
    assert not buffer.is_behind(B)


def test_an_input_is_idle_when_nothing_waits_and_nothing_came_for_a_while(make):
    """The time counts from the beginning of the buffer."""
    buffer = make(10, ROOM, 100.0)
    assert not buffer.is_idle(A, 100.5, 0.0, 1.0)
    assert buffer.is_idle(A, 101.0, 0.0, 1.0)
    assert not buffer.is_idle(A, 101.0, 100.5, 1.0)
    buffer.add(A, Sent(1), None, 101.0)
    assert not buffer.is_idle(A, 103.0, 0.0, 1.0)
    cover(buffer, A, [1], single=True, now=0.0)
    assert buffer.is_idle(A, 103.0, 0.0, 1.0)


def test_an_input_that_the_source_is_sent_is_not_idle(make):
    """A reliable reader may still wait for a message that was lost on its way."""
    buffer = make(10, ROOM, 100.0)
    cover(buffer, A, [1, 2], single=True, now=102.0)
    assert not buffer.is_idle(A, 102.5, 0.0, 1.0)
    cover(buffer, A, [2, 3], single=True, now=102.6)
    assert not buffer.is_idle(A, 103.5, 0.0, 1.0)
    cover(buffer, A, [2, 3], single=True, now=103.5)
    assert buffer.is_idle(A, 103.6, 0.0, 1.0)


@given(st.data())
def test_source_and_successor_together_process_each_message_once(make, data):
    """This holds for any interleaving of messages and marks, and any stop of the source."""
    total = data.draw(st.integers(1, 12))
    joined = data.draw(st.integers(0, total))  # the shadow receives messages from here on
    stopped = data.draw(st.integers(joined, total))  # the source processes those before it
    messages = [("message", stamp) for stamp in range(joined, total)]
    marks = [("mark", covered) for covered in range(stopped + 1)]
    events = []
    while messages or marks:
        first = data.draw(st.sampled_from([queue for queue in (messages, marks) if queue]))
        events.append(first.pop(0))
    buffer = make(100, ROOM, 0.0)
    for kind, value in events:
        if kind == "message":
            assert buffer.add(A, Sent(value), None, 0.0)
        else:
            cover(buffer, A, range(value)[-3:], processed=value, single=True, now=0.0)
    assert drained(buffer) == [(A, stamp) for stamp in range(stopped, total)]
