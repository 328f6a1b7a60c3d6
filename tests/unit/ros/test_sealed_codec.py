"""CDR form of sealed messages: rclpy reads it, and it is read as rclpy writes it."""

from __future__ import annotations

from array import array

import pytest
from hypothesis import given
from hypothesis import strategies as st
from rclpy.serialization import deserialize_message, serialize_message

from rosrm.ros.sealed_codec import Envelope, decode, encode
from rosrm_msgs import msg

RUN, RECEIVER = bytes(range(16)), bytes(range(100, 116))


def envelope(principal: str = "instance:p#1", body: bytes = b"sealed") -> Envelope:
    return Envelope(1, principal, 2**32 - 2, RUN, RECEIVER, 2**64 - 3, body)


@pytest.mark.parametrize("letters", range(9))
@pytest.mark.parametrize("length", [0, 1, 7, 8, 1000])
def test_each_side_reads_what_the_other_writes(letters: int, length: int) -> None:
    """Padding depends on the length of the principal, and rclpy's is not zero."""
    one = envelope("p" * letters, bytes(length))
    message = msg.Sealed(
        format=1, principal=one.principal, generation=one.generation, run=array("B", RUN),
        receiver_run=array("B", RECEIVER), counter=one.counter, body=array("B", one.body),
    )  # fmt: skip
    data = encode(one)
    assert deserialize_message(data, msg.Sealed) == message
    assert decode(serialize_message(message)) == one


def test_a_message_that_ends_early_or_claims_too_much_is_malformed() -> None:
    data = encode(envelope())
    for end in range(len(data)):
        assert decode(data[:end]) is None
    assert decode(b"\0\0" + data[2:]) is None  # big-endian
    assert decode(encode(envelope("p" * 1000))) is None


@pytest.mark.parametrize(("run", "receiver_run"), [(0, 16), (15, 17), (17, 15), (16, 0)])
def test_a_message_with_a_run_of_another_length_is_malformed(run: int, receiver_run: int) -> None:
    """Otherwise a run would contain bytes of the next field."""
    message = msg.Sealed(run=array("B", bytes(run)), receiver_run=array("B", bytes(receiver_run)))
    assert decode(serialize_message(message)) is None


@given(st.binary(max_size=200))
def test_any_bytes_can_be_decoded(data: bytes) -> None:
    """A stranger can send anything; nothing raises."""
    decode(data)
    decode(b"\0\1\0\0" + data)
