"""Decoders that run before any key is checked: envelopes, readings, principals, tickets."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from rosrm.keys.cluster import ClusterSecret
from rosrm.keys.security import MasterSecurity, MemberSecurity
from rosrm.keys.tickets import ticket_of
from rosrm.ros.master_socket import request_of, service_and_envelope
from rosrm.ros.reading_codec import Reading
from rosrm.ros.reading_codec import encode as encode_reading
from rosrm.ros.sealed_codec import Envelope, decode, encode
from rosrm.ros.sealed_readings import RegisteredSlave, open_reading, seal_reading
from tests.fuzz.hostile import damaged_bytes, fuzzed, texts

CHANNEL = b"c" * 16
SECRET = ClusterSecret(b"s" * 32)
ENVELOPE = encode(Envelope(1, "host:a", 0, b"r" * 16, b"m" * 16, 7, b"body"))


@fuzzed(300)
@given(data=damaged_bytes(ENVELOPE) | st.binary(max_size=200))
def test_an_envelope_is_read_or_nothing(data: bytes) -> None:
    """One that is read has all its fields in the bytes that came."""
    envelope = decode(data)
    if envelope is not None:
        assert (len(envelope.run), len(envelope.receiver_run)) == (16, 16)
        assert len(envelope.body) <= len(data)


@fuzzed(300)
@given(data=damaged_bytes(request_of("/rosrm/list", decode(ENVELOPE))) | st.binary(max_size=200))
def test_a_request_of_the_socket_is_read_or_nothing(data: bytes) -> None:
    """The service is a text, and the envelope has all its fields in the bytes that came."""
    service, envelope = service_and_envelope(data)
    assert len(service) <= len(data)
    assert envelope is None or len(envelope.run) == len(envelope.receiver_run) == 16


def _reading(host: int) -> bytes:
    return encode_reading(Reading(host_id=host))


@fuzzed(150)
@given(change=damaged_bytes(bytes(240)))
def test_a_changed_reading_does_not_open(change: bytes) -> None:
    """Only the bytes that the slave sent open."""
    master = MasterSecurity(SECRET)
    slave = master.peer("host:a", 0)
    part = MemberSecurity(SECRET.key_of(slave.grant))
    part.master.run = master.run
    sent = seal_reading(part.master, CHANNEL, _reading(3))
    changed = bytes(one ^ other for one, other in zip(sent, change, strict=False))
    changed += change[len(sent) :]
    registered = RegisteredSlave.of(slave, part.run, CHANNEL, since=0.0)
    opened = open_reading(changed, master.run, {3: registered}.get)
    assert opened in (None, _reading(3))
    assert opened is None or changed[4:] == sent[4:], "the first bytes are the header of CDR"


@fuzzed(300)
@given(name=texts | texts.map("ticket:1:2:read_log:".__add__), generation=st.integers(0, 2**32 - 1))
def test_a_name_is_of_a_principal_or_of_nothing(name: str, generation: int) -> None:
    """A ticket has one text; a name that is read keeps nothing until a message has opened."""
    ticket = ticket_of(name)
    assert ticket is None or ticket.text() == name
    master = MasterSecurity(SECRET)
    master.peer(name, generation)
    assert not master._peers
