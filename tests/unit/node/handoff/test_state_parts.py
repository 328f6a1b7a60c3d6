"""Errors of a state that cannot be saved."""

from __future__ import annotations

import struct
import zlib

import pytest
from hypothesis import given
from hypothesis import strategies as st
from std_msgs.msg import Int64, String, UInt8MultiArray

from rosrm.node.handoff import state_parts
from rosrm.node.handoff.state_parts import StateError, StateTopic


def part(*answers):
    """Return a part whose author's function gives these answers in turn."""
    left = iter(answers)
    return StateTopic("/state", Int64, lambda: next(left), lambda message: None)


def test_an_error_is_reported_again_while_nothing_has_changed(monkeypatch):
    """A later call names the original cause, instead of a state that was never saved."""
    monkeypatch.setattr(state_parts, "LARGEST_PART", 4)
    one = part(Int64(data=7), None, None)
    for _ in range(3):
        with pytest.raises(StateError, match="has 12 bytes, more than the 4"):
            one.refresh()


def test_a_state_that_is_well_again_may_be_unchanged():
    """A later fault is a new one."""
    one = part(String(), Int64(data=7), None, String())
    with pytest.raises(StateError, match="returned a String"):
        one.refresh()
    one.refresh()
    one.refresh()
    with pytest.raises(StateError, match="returned a String"):
        one.refresh()


def test_unchanged_before_anything_was_saved_is_a_fault():
    """The author's function refers to a state that does not exist."""
    with pytest.raises(StateError, match="before it had returned any state"):
        part(None).refresh()


def test_an_unchanged_part_is_shown_once_to_each_successor():
    """A later handoff has another key, and its destination needs the part again."""
    one, shown = part(Int64(data=7), None, None, None), []
    for successor in "ab":
        one.show_to(lambda data, to=successor: shown.append((to, len(data))))
        one.publish()
        one.publish()
    assert shown == [("a", 12), ("b", 12)]


def ends_with_its_crc(number):
    """Return a state whose CRC-32 is the same for each number."""
    record = struct.pack("<Q", number)
    return UInt8MultiArray(data=record + struct.pack("<I", zlib.crc32(record)))


@given(st.lists(st.integers(0, 3), min_size=1))
def test_each_change_of_a_state_is_published_named_and_restored(numbers):
    """Many formats end with a CRC, so that all contents of one size have the same CRC."""
    states, published, restored = iter(numbers), [], []
    one = StateTopic(
        "/state", UInt8MultiArray, lambda: ends_with_its_crc(next(states)), lambda message: None
    )
    other = StateTopic("/state", UInt8MultiArray, lambda: None, restored.append)
    one.show_to(published.append)
    keys = {}
    for number in numbers:
        one.publish()
        other.restore_changed(published[-1])
        assert restored[-1] == ends_with_its_crc(number)
        keys[number] = one.described().digest
        assert one.block().data == published[-1]
    assert len(set(keys.values())) == len(set(numbers))
    changes = [b for a, b in zip([None, *numbers], numbers, strict=False) if a != b]
    assert len(published) == len(restored) == len(changes)
