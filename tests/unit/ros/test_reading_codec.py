"""Binary encoding of `resource_info`: equal to rclpy's own serialisation."""

from __future__ import annotations

from array import array
from dataclasses import fields, replace

import numpy as np
import pytest
from rclpy.serialization import deserialize_message, serialize_message

from rosrm.model.values import RESOURCE_SLOTS
from rosrm.ros.master.reading_decoder import LAYOUT, decode
from rosrm.ros.reading_codec import (
    ACCEPTING,
    MOST_QUIET,
    READING_BYTES,
    Reading,
    encode,
    flags,
)
from rosrm.version import PROTOCOL_VERSION
from rosrm_msgs import msg

NUMBERS = {
    "protocol_version": PROTOCOL_VERSION, "flags": ACCEPTING, "host_id": 0xFEDCBA98,
    "incarnation": 0xFEDCBA9876543210, "sequence": 3, "beat": 2**63 + 5, "master_beat": 6,
    "status_sequence": 2**40, "processes": 8, "present": 0xFFFF, "stale": 0b101,
}  # fmt: skip
USAGE = array("f", np.linspace(0.0, 1.5, RESOURCE_SLOTS))
LIMIT = array("f", np.linspace(1.0, 0.1, RESOURCE_SLOTS))
READING = Reading(**NUMBERS, usage=USAGE, limit=LIMIT)


def info(**changes) -> msg.ResourceInfo:
    return msg.ResourceInfo(**{**NUMBERS, "usage": USAGE, "limit": LIMIT, **changes})


def beats(decoded) -> dict:
    """Return the newest beat of each run: (host id, incarnation) to beat."""
    runs = decoded.runs
    hosts = zip(runs.host_id.tolist(), runs.incarnation.tolist(), strict=True)
    return dict(zip(hosts, runs.beat.tolist(), strict=True))


def test_encoding_is_what_rclpy_writes() -> None:
    """A reader in any language receives the message that rclpy would have sent."""
    assert encode(READING) == serialize_message(info())


def test_every_byte_is_a_field() -> None:
    """Each field is where rclpy reads the field of that name."""
    nothing = array("f", RESOURCE_SLOTS * [0.0])
    for field in fields(Reading):
        zero = 0 if field.name in NUMBERS else nothing
        expected = replace(READING, **{field.name: zero})
        message = deserialize_message(encode(expected), msg.ResourceInfo)
        for name in message.get_fields_and_field_types():
            assert getattr(message, name) == getattr(expected, name), name


def test_the_decoder_has_the_same_fields() -> None:
    """Its arrays are where the encoder writes the fields of the same names."""
    assert LAYOUT.itemsize == READING_BYTES == len(encode(READING))
    row = np.frombuffer(encode(READING), LAYOUT)[0]
    for field in fields(Reading):
        np.testing.assert_array_equal(row[field.name], getattr(READING, field.name))


def test_decoding_what_rclpy_writes() -> None:
    """A reading from a slave in another language is decoded correctly."""
    decoded = decode([serialize_message(info(host_id=5, incarnation=9, sequence=4))])

    readings = decoded.readings
    assert decoded.received == 1
    assert decoded.refusals == ()
    assert readings.host_id.tolist() == [5]
    assert readings.incarnation.tolist() == [9]
    assert readings.sequence.tolist() == [4]
    assert readings.status_sequence.tolist() == [2**40]
    assert readings.accepting.tolist() == [True]
    assert readings.stale.tolist() == [0b101]
    np.testing.assert_array_equal(readings.usage[0], USAGE)
    np.testing.assert_array_equal(readings.limit[0], LIMIT)
    assert beats(decoded) == {(5, 9): 2**63 + 5}


def test_newest_of_each_host_counts() -> None:
    """The last of several readings of one run of a host counts."""
    batch = [
        serialize_message(info(host_id=host, sequence=sequence, beat=sequence))
        for sequence, host in enumerate([1, 2, 1, 3, 2, 1])
    ]

    decoded = decode(batch)

    newest = dict(
        zip(decoded.readings.host_id.tolist(), decoded.readings.sequence.tolist(), strict=True)
    )
    assert newest == {1: 5, 2: 4, 3: 3}
    assert decoded.received == 6


def test_unpublished_cycles_are_counted_by_the_next_message() -> None:
    """A message counts its own cycle and the idle ones before it, up to the greatest number."""
    batch = [
        serialize_message(info(host_id=host, sequence=sequence, flags=flags(**said)))
        for host, sequence, said in (
            (1, 3, {"accepting": True, "quiet": 2}),
            (2, 9, {"accepting": False, "quiet": MOST_QUIET}),
            (1, 4, {"accepting": False, "quiet": 0}),
        )
    ]

    decoded = decode(batch)

    assert decoded.runs.host_id.tolist() == [1, 2]
    assert decoded.runs.sequence.tolist() == [4, 9]
    assert decoded.runs.cycles.tolist() == [4, 1 + MOST_QUIET]
    assert decoded.readings.accepting.tolist() == [False, False]


def test_a_former_run_hides_no_reading() -> None:
    """Late messages of a former run replace neither reading nor beat of the new run."""
    now = serialize_message(info(host_id=1, incarnation=20, sequence=1, beat=100))
    late = serialize_message(info(host_id=1, incarnation=10, sequence=900, beat=5))

    decoded = decode([now, late])

    assert sorted(decoded.readings.incarnation.tolist()) == [10, 20]
    assert beats(decoded) == {(1, 20): 100, (1, 10): 5}


@pytest.mark.parametrize(
    ("raw", "said"),
    [
        (serialize_message(info(protocol_version=99)), "version 99"),
        (serialize_message(info())[:-1], "another size"),
        (serialize_message(info()) + b"\0", "another size"),
        (b"\0\0" + serialize_message(info())[2:], "another size"),
        (serialize_message(info(usage=USAGE[1:], limit=array("f", [0.0, *LIMIT]))), "another size"),
        (b"", "another size"),
    ],
    ids=["version", "short", "long", "big-endian", "other numbers of slots", "empty"],
)
def test_strangers_are_refused(raw, said) -> None:
    """Another version, size or byte order is refused with a message, and not decoded."""
    alone = decode([raw])
    assert alone.readings is None
    assert len(alone.refusals) == 1
    assert said in alone.refusals[0]

    among_ours = decode([raw, serialize_message(info(host_id=3)), raw])
    assert among_ours.readings.host_id.tolist() == [3]
    assert len(among_ours.refusals) == 1
    assert among_ours.received == 1


def test_nothing_is_nothing() -> None:
    """No message gives no event."""
    assert decode([]).readings is None
