"""CDR form of signed messages: it is read as rclpy writes it."""

from __future__ import annotations

import struct
from array import array

import pytest
from hypothesis import given
from hypothesis import strategies as st
from rclpy.serialization import serialize_message

from rosrm.keys.security import SIGNATURE_BYTES
from rosrm.ros.bounds import MOST_ENTRIES
from rosrm.ros.signed_codec import SignedMessage, decode
from rosrm_msgs import msg

RUN, SIGNATURE = bytes(range(16)), bytes(range(SIGNATURE_BYTES))


def written(body: bytes = b"signed", form: int = 1) -> bytes:
    return serialize_message(
        msg.Signed(
            format=form, run=array("B", RUN), counter=2**64 - 3, signature=array("B", SIGNATURE),
            body=array("B", body),
        )
    )  # fmt: skip


@pytest.mark.parametrize("length", [0, 1, 7, 8, MOST_ENTRIES])
def test_a_message_is_read_as_rclpy_writes_it(length: int) -> None:
    body = bytes(length)
    assert decode(written(body)) == SignedMessage(RUN, 2**64 - 3, SIGNATURE, body)


def test_a_message_that_ends_early_is_too_large_or_of_another_format_is_not_read() -> None:
    data = written()
    for end in range(struct.calcsize("<120xI") + len(b"signed")):
        assert decode(data[:end]) is None
    assert decode(b"\0\0" + data[2:]) is None  # big-endian
    assert decode(written(form=2)) is None
    assert decode(written(bytes(MOST_ENTRIES + 1))) is None


def test_the_signature_covers_run_counter_and_body() -> None:
    message = decode(written())
    assert message is not None
    assert (
        message.content(b"channel") == b"channel" + RUN + struct.pack("<Q", 2**64 - 3) + b"signed"
    )


@given(st.binary(max_size=200))
def test_any_bytes_can_be_decoded(data: bytes) -> None:
    """Any participant can send any bytes; `decode` raises for none of them."""
    decode(data)
    decode(b"\0\1\0\0" + data)
