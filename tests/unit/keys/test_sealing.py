"""Derived keys and sealed messages."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rosrm.keys.cluster import ClusterSecret
from rosrm.keys.derivation import derived
from rosrm.keys.roles import Grant, Principal, Role
from rosrm.keys.sealing import OVERHEAD, Direction, Opener, Sealer, channel_key, channel_of

VECTORS = Path(__file__).parents[2] / "data" / "keys" / "vectors.json"

SUBMIT = channel_of("/rosrm/submit", "rosrm_msgs/srv/Submit_Request")
KEY = channel_key(bytes(32), Direction.TO_MASTER, bytes(16), SUBMIT)


def test_the_format_is_that_of_the_test_vectors() -> None:
    """Another language makes the same keys and messages from docs/reference/keys.md."""
    vector = json.loads(VECTORS.read_text())
    secret = ClusterSecret(bytes.fromhex(vector["secret"]))
    robot = secret.key_of(Grant(Principal("host", "robot-1"), Role.HOST, vector["generation"]))
    assert robot.key.hex() == vector["principal_key"]
    assert robot.master.hex() == vector["master_public_key"]
    channel = channel_of(vector["channel_name"], vector["channel_type"])
    assert channel.hex() == vector["channel"]
    run = bytes.fromhex(vector["run"])
    key = channel_key(robot.key, Direction.TO_MASTER, run, channel)
    assert key.hex() == vector["channel_key"]
    sealer = Sealer(key, counter=vector["counter"] - 1)
    sealed = sealer.seal(bytes.fromhex(vector["plaintext"]), bytes.fromhex(vector["context"]))
    assert (sealer.counter, sealed.hex()) == (vector["counter"], vector["sealed"])


@given(st.lists(st.binary(max_size=300), max_size=8), st.binary(max_size=40))
def test_messages_are_opened_once_and_in_order(messages: list[bytes], context: bytes) -> None:
    """Each message opens unchanged; a repeated or late message does not open."""
    sealer, opener = Sealer(KEY), Opener(KEY)
    sent = [(message, sealer.seal(message, context), sealer.counter) for message in messages]
    for message, sealed, counter in sent:
        assert len(sealed) == len(message) + OVERHEAD
        assert opener.open(counter, sealed, context) == message
    for _, sealed, counter in sent:
        assert opener.open(counter, sealed, context) is None


@given(st.data())
def test_a_changed_message_does_not_open(data: st.DataObject) -> None:
    """A bit, the counter, the context or the length differs; the genuine message still opens."""
    message, context = data.draw(st.binary(max_size=60)), data.draw(st.binary(max_size=20))
    sealer, opener = Sealer(KEY), Opener(KEY)
    sealed = sealer.seal(message, context)
    bit = data.draw(st.integers(0, 8 * len(sealed) - 1))
    flipped = bytearray(sealed)
    flipped[bit // 8] ^= 1 << bit % 8
    assert opener.open(1, bytes(flipped), context) is None
    assert opener.open(data.draw(st.integers(2, 2**64 - 1)), sealed, context) is None
    assert opener.open(1, sealed, context + b"x") is None
    assert opener.open(1, sealed[: data.draw(st.integers(0, len(sealed) - 1))], context) is None
    assert opener.open(1, sealed, context) == message


@pytest.mark.parametrize("counter", [0, -1, 2**64, 2**80])
def test_a_counter_out_of_range_does_not_open(counter: int) -> None:
    """Counters begin at 1 and have 64 bits."""
    assert Opener(KEY).open(counter, Sealer(KEY).seal(b"x")) is None


@pytest.mark.parametrize("part", [Sealer, Opener])
def test_a_key_of_another_length_is_refused(part: type) -> None:
    """A shorter key would make libsodium read beyond its end."""
    with pytest.raises(ValueError, match="a key must have 32 bytes, this one has 31"):
        part(bytes(31))


def test_each_use_has_a_key_of_its_own() -> None:
    """Directions, runs, channels (by name and by type), principals and generations differ."""
    secret = ClusterSecret(bytes(32))
    grants = [
        Grant(Principal(kind, name), Role.VIEWER, generation)
        for kind in ("host", "user")
        for name in ("a", "b")
        for generation in (0, 1)
    ]
    keys = {secret.key_of(grant).key for grant in grants}
    channels = [channel_of(name, kind) for name in ("/a", "/b") for kind in ("x", "y")]
    runs = [bytes(16), bytes([1] * 16)]
    used = {
        channel_key(key, direction, run, channel)
        for key in keys
        for direction in Direction
        for run in runs
        for channel in channels
    }
    assert len(keys) == len(grants)
    assert len(used) == len(grants) * len(Direction) * len(runs) * len(channels)


@given(*[st.lists(st.one_of(st.text(max_size=5), st.binary(max_size=5)), max_size=4)] * 2)
def test_different_arguments_give_different_keys(
    first: list[str | bytes], second: list[str | bytes]
) -> None:
    """The limits between arguments count: ("ab", "c") is not ("a", "bc")."""
    same = [part.encode() if isinstance(part, str) else part for part in first] == [
        part.encode() if isinstance(part, str) else part for part in second
    ]
    assert (derived(bytes(32), "p", *first) == derived(bytes(32), "p", *second)) is same
