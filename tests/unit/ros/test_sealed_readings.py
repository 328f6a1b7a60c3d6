"""Sealed readings: what the master opens, and that rclpy writes and reads the same form."""

from __future__ import annotations

from array import array

import pytest
from rclpy.serialization import deserialize_message, serialize_message

from rosrm.keys.cluster import ClusterSecret, own_grant
from rosrm.keys.roles import Principal
from rosrm.keys.security import MasterSecurity, MemberSecurity, NoSecurity
from rosrm.ros.reading_codec import Reading, encode
from rosrm.ros.sealed_readings import (
    RegisteredSlave,
    may_be_of_former_run,
    open_reading,
    reading_channel,
    seal_reading,
)
from rosrm_msgs import msg

HOST = Principal("host", "robot-1")
HOST_ID = 7
CHANNEL = reading_channel("/rosrm/resource_info")
SECRET = ClusterSecret(bytes(range(32)))
#: Where a message has its parts.
FORMAT, COUNTER, LENGTH, BODY = slice(8, 12), slice(12, 20), slice(20, 24), 24


def reading(host_id: int = HOST_ID) -> bytes:
    return encode(Reading(host_id=host_id, sequence=5))


class Sides:
    """A master and the slave of one host, which has registered."""

    def __init__(self, mode: str) -> None:
        if mode == "keys":
            self.master, self.slave = (
                MasterSecurity(SECRET), MemberSecurity(SECRET.key_of(own_grant(HOST)))
            )  # fmt: skip
        else:
            self.master, self.slave = NoSecurity(), NoSecurity(HOST)
        self.slave.master.run = self.master.run
        self.slaves = {HOST_ID: self.registered(HOST, self.slave.run)}

    def registered(self, host: Principal, run: bytes, channel: bytes = CHANNEL) -> RegisteredSlave:
        return RegisteredSlave.of(self.master.peer(str(host), 0), run, channel, since=100.0)

    def sealed(self, plain: bytes | None = None) -> bytes:
        return seal_reading(self.slave.master, CHANNEL, plain or reading())

    def opened(self, data: bytes) -> bytes | None:
        return open_reading(data, self.master.run, self.slaves.get)

    def may_be_old(self, data: bytes, now: float = 110.0) -> bool:
        return may_be_of_former_run(data, self.slaves.get, now)


@pytest.fixture(params=["keys", "none"])
def sides(request) -> Sides:
    return Sides(request.param)


@pytest.fixture
def keyed() -> Sides:
    return Sides("keys")


def changed(data: bytes, where: slice, value: int) -> bytes:
    raw = bytearray(data)
    raw[where] = value.to_bytes(where.stop - where.start, "little")
    return bytes(raw)


def test_the_master_opens_what_the_slave_seals(sides) -> None:
    """Each reading opens, in order, and gaps do not matter: readings may be lost."""
    sent = [sides.sealed(reading()) for _ in range(3)]
    assert [sides.opened(one) for one in (sent[0], sent[2])] == 2 * [reading()]


def test_rclpy_reads_the_form(sides) -> None:
    """The type of the topic is `SealedReading`, so that ROS tools show its messages."""
    data = sides.sealed()
    message = deserialize_message(data, msg.SealedReading)
    assert (message.host_id, message.format, message.counter) == (HOST_ID, 1, 1)
    assert bytes(message.body) == data[BODY:]
    assert serialize_message(message) == data


def test_the_master_opens_the_form_of_rclpy(sides) -> None:
    """A slave in another language may use the serialisation of its ROS library."""
    data = sides.sealed()
    number = int.from_bytes(data[COUNTER], "little")
    message = msg.SealedReading(
        host_id=HOST_ID, format=1, counter=number, body=array("B", data[BODY:])
    )
    assert sides.opened(serialize_message(message)) == reading()


@pytest.mark.parametrize("cut", [0, 1, 4, 23, 24, 239])
def test_a_message_of_another_size_does_not_open(sides, cut: int) -> None:
    data = sides.sealed()
    assert sides.opened(data[:cut]) is None
    assert sides.opened(data + b"\0") is None
    assert not sides.may_be_old(data[:cut], now=101.0)


def test_a_message_of_another_format_does_not_open(sides) -> None:
    assert sides.opened(changed(sides.sealed(), FORMAT, 2)) is None


def test_a_message_whose_body_has_another_length_does_not_open(sides) -> None:
    data = sides.sealed()
    assert sides.opened(changed(data, LENGTH, len(data) - BODY - 1)) is None
    assert sides.opened(data) == reading()


def test_a_message_of_an_unknown_host_does_not_open(sides) -> None:
    """A slave sends some after a restart of the master, until it notices it."""
    data = sides.sealed(reading(8))
    assert sides.opened(data) is None
    assert sides.may_be_old(data)


def test_a_reading_of_another_host_than_its_head_names_does_not_open(sides) -> None:
    """A slave speaks for its own host alone."""
    sides.slaves[8] = sides.slaves[HOST_ID]
    data = changed(sides.sealed(), slice(4, 8), 8)
    assert sides.opened(data) is None
    assert not sides.may_be_old(data)


def test_a_slave_does_not_open_as_another_host(keyed) -> None:
    """Neither by the number in the head, nor by that of the reading."""
    keyed.slaves[8] = keyed.registered(Principal("host", "robot-2"), keyed.slave.run)
    assert keyed.opened(keyed.sealed(reading(8))) is None
    assert keyed.opened(changed(keyed.sealed(), slice(4, 8), 8)) is None


@pytest.mark.parametrize("at", [COUNTER.start, BODY, BODY + 100, 239])
def test_a_changed_message_does_not_open(keyed, at: int) -> None:
    """The first header is not covered; nothing depends on it."""
    data = keyed.sealed()
    assert keyed.opened(changed(data, slice(at, at + 1), data[at] ^ 1)) is None
    assert keyed.opened(data) == reading()


def test_a_repetition_does_not_open(keyed) -> None:
    first, second = keyed.sealed(), keyed.sealed()
    assert keyed.opened(second) == reading()
    assert keyed.opened(second) is None
    assert keyed.opened(first) is None


def test_a_repetition_does_not_open_after_another_registration(keyed) -> None:
    """A slave that was cut off for a while registers again in the same run."""
    peer, data = keyed.slaves[HOST_ID].peer, keyed.sealed()
    assert keyed.opened(data) == reading()
    keyed.slaves[HOST_ID] = RegisteredSlave.of(peer, keyed.slave.run, CHANNEL, since=0.0)
    assert keyed.opened(data) is None
    assert keyed.opened(keyed.sealed()) == reading()


def test_a_message_for_another_run_of_the_master_does_not_open(keyed) -> None:
    """Recorded readings are worth nothing after a restart of the master."""
    data = keyed.sealed()
    run = MasterSecurity(SECRET).run
    assert open_reading(data, run, keyed.slaves.get) is None


def test_a_message_of_another_run_of_the_slave_does_not_open(keyed) -> None:
    """The run of the slave is that of its last registration.

    If the master was stopped, it takes the last readings of a former run after that registration.
    """
    data = keyed.sealed()
    keyed.slaves[HOST_ID] = keyed.registered(HOST, bytes(16))
    assert keyed.opened(data) is None
    assert keyed.may_be_old(data, now=104.0)
    assert not keyed.may_be_old(data, now=106.0)


def test_a_message_of_another_topic_does_not_open(keyed) -> None:
    other = reading_channel("/other/resource_info")
    keyed.slaves[HOST_ID] = keyed.registered(HOST, keyed.slave.run, other)
    assert keyed.opened(keyed.sealed()) is None
