"""The C++ core against its counterparts in Python: messages, sealed messages, snapshot files."""

from __future__ import annotations

import ctypes
import zlib
from array import array

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rclpy.serialization import deserialize_message, serialize_message

from rosrm.node.snapshots.marks import decoded_mark
from rosrm.ros.sealed_codec import Envelope, encode
from rosrm.snapshots import reader
from rosrm.snapshots.format import Block
from rosrm.snapshots.writer import SlotWriter
from rosrm.version import PROTOCOL_VERSION
from rosrm_msgs.msg import (
    CoveredInput,
    HandoffReport,
    MatchedOutput,
    Sealed,
    StateConfig,
    StateMark,
    StatePart,
)
from tests.cpp.core_library import PACKAGE, loaded
from tests.old_marks import old_mark

text = st.text(st.characters(codec="utf-8", exclude_characters="\0"), max_size=9)
u8, u32, u64 = (st.integers(0, 2**bits - 1) for bits in (8, 32, 64))
stamps = st.lists(st.integers(-(2**63), 2**63 - 1), max_size=4).map(lambda one: array("q", one))
data = st.binary(max_size=9).map(lambda one: array("B", one))
runs = st.binary(min_size=16, max_size=16).map(lambda one: array("B", one))
phase = st.integers(0, 255)


def lists(make, **fields):
    return st.lists(st.builds(make, **fields), max_size=3)


#: Messages by the number of their kind in bridge.cpp.
MESSAGES = {
    0: st.builds(
        StateConfig, protocol_version=st.integers(0, 2**16 - 1), cluster=text, epoch=u64,
        phase=phase, process=text, source=u64, destination=u64, source_node=text,
        destination_node=text, channel=text, key=data, source_run=u64,
    ),
    1: st.builds(
        HandoffReport, destination=u64, instance=u64, run=u64, phase=phase, sequence=u64,
        message=text,
    ),
    2: st.builds(
        StateMark, protocol_version=st.just(PROTOCOL_VERSION), run=u64, sequence=u64,
        last=st.booleans(), timers_due=stamps,
        parts=lists(StatePart, topic=text, type=text, size=u64, digest=text),
        inputs=lists(CoveredInput, topic=text, publishers=u32, processed=u64, covered=stamps),
        outputs=lists(MatchedOutput, topic=text, subscriptions=u32),
    ),
    3: st.builds(
        Sealed, format=u8, principal=text, generation=u32, counter=u64, body=data,
        run=runs, receiver_run=runs,
    ),
}  # fmt: skip
cases = st.integers(0, 3).flatmap(lambda kind: st.tuples(st.just(kind), MESSAGES[kind]))


@pytest.fixture(scope="module")
def core(cpp_core):
    """Return the library of the core."""
    return loaded(cpp_core)


def rewritten(core, kind: int, message: bytes) -> bytes | None:
    """Return a message that the core has read and written; None: it is malformed."""
    room = ctypes.create_string_buffer(2 * len(message) + 64)
    size = core.message_round_trip(kind, message, len(message), room)
    return None if size < 0 else room.raw[:size]


@given(case=cases)
def test_messages_are_read_and_written_as_by_ros(core, case):
    """The core has no ROS types; its messages are those of rclpy."""
    kind, message = case
    again = rewritten(core, kind, serialize_message(message))
    assert again is not None
    assert deserialize_message(again, type(message)) == message


@given(mark=MESSAGES[2], version=st.integers(5, 7))
def test_marks_of_earlier_releases_are_read(core, mark, version):
    """Snapshots with marks of earlier releases are restored after an update, also in C++."""
    mark.protocol_version = version
    data = old_mark(mark)
    found, again = decoded_mark(data), rewritten(core, 2, data)
    for part in mark.parts:
        part.digest = ""
    for one in mark.inputs:
        one.processed = len(one.covered)
    assert found == mark
    assert again is not None
    assert deserialize_message(again, StateMark) == mark


@given(
    case=cases, cut=st.integers(0, 40), noise=st.lists(st.tuples(st.integers(0), u8), max_size=3)
)
@settings(max_examples=300)
def test_damaged_messages_end_no_process(core, case, cut, noise):
    """A stranger may send any bytes; the result is a message or a refusal."""
    kind, message = case
    damaged = bytearray(serialize_message(message))
    for at, value in noise:
        damaged[at % len(damaged)] = value
    rewritten(core, kind, bytes(damaged[: len(damaged) - cut]))


def test_an_envelope_of_the_own_codec_is_read(core):
    """`rosrm.ros.sealed_codec` writes what nodes of the project send."""
    envelope = encode(Envelope(1, "instance:p#1", 0, bytes(16), bytes(16), 7, b"body"))
    again = rewritten(core, 3, envelope)
    assert again is not None
    assert deserialize_message(again, Sealed).counter == 7
    assert again == envelope


@pytest.mark.parametrize(("run", "receiver_run"), [(0, 16), (15, 17), (17, 15), (16, 0)])
def test_an_envelope_with_a_run_of_another_length_is_malformed(core, run, receiver_run):
    """Otherwise a run would contain bytes of the next field."""
    sent = Sealed(run=array("B", bytes(run)), receiver_run=array("B", bytes(receiver_run)))
    assert rewritten(core, 3, serialize_message(sent)) is None


def newest(core, directory, up_to=9) -> str:
    return core.snapshot_newest(str(directory).encode(), ctypes.c_uint64(up_to)).decode()


def written(core, directory, instance, sequence, data: bytes) -> bool:
    number, cycles = ctypes.c_uint64(instance), ctypes.c_uint64(sequence)
    write = core.snapshot_write
    size = ctypes.c_size_t(len(data))
    return bool(write(str(directory).encode(), b"counter", number, cycles, data, size) == 1)


def test_snapshots_of_each_implementation_are_read_by_the_other(core, tmp_path):
    """A process may be restarted as a node of the other language."""
    slots = SlotWriter(tmp_path / "a", "counter", 3)
    assert slots.write(5, [Block(b"five", zlib.crc32(b"five"))])
    slots.close()
    assert newest(core, tmp_path / "a") == "3 5 five; 0 damaged"
    assert written(core, tmp_path / "b", 4, 6, b"six")
    found, faults = reader.newest(tmp_path / "b", up_to=4)
    assert found is not None
    assert (found.head.instance, found.head.sequence, found.blocks, faults) == (4, 6, (b"six",), [])


def test_the_newest_complete_snapshot_is_used_and_spared(core, tmp_path):
    """A damaged file gives way to the one before, and a newer instance's is not overwritten."""
    for sequence in (1, 2, 3):
        assert written(core, tmp_path, 3, sequence, b"%d" % sequence)
    assert newest(core, tmp_path) == "3 3 3; 0 damaged"
    assert newest(core, tmp_path, up_to=2) == "none; 0 damaged"
    path = reader.snapshot_files(tmp_path)[0][0]
    path.write_bytes(path.read_bytes()[:-1] + b"x")
    assert newest(core, tmp_path) == "3 2 2; 1 damaged"
    assert written(core, tmp_path, 5, 1, b"newer")
    assert written(core, tmp_path, 5, 2, b"newer")
    assert not written(core, tmp_path, 3, 4, b"older")
    assert newest(core, tmp_path) == "5 2 newer; 0 damaged"


def test_both_speak_the_same_version():
    """A node of another version is refused in every handoff."""
    header = (PACKAGE / "include/rosrm_node_cpp/core/messages.hpp").read_text()
    assert f"kProtocolVersion = {PROTOCOL_VERSION};" in header
