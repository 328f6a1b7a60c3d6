"""Packets that measure links: only holders of the key can make them."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rosrm.keys.cluster import ClusterSecret
from rosrm.keys.link_packets import PACKET_BYTES, Packet, echo, opened, probe
from rosrm.keys.roles import Grant, Principal, Role
from rosrm.keys.security import MasterSecurity, MemberSecurity

KEY, NONCE = b"k" * 32, b"n" * 16
PROBE = Packet(False, 3, NONCE, 0)


def test_probe_and_echo_survive() -> None:
    """The echo has the random number of its probe, and the time that it has waited."""
    assert opened(probe(KEY, 3, NONCE), lambda _: KEY) == PROBE
    assert opened(echo(KEY, PROBE, 5_000), lambda _: KEY) == Packet(True, 3, NONCE, 5_000)


@given(st.integers(0, PACKET_BYTES - 1), st.integers(1, 255))
def test_a_packet_with_one_changed_byte_is_dropped(at: int, change: int) -> None:
    """Nothing of a packet can be changed."""
    data = bytearray(echo(KEY, PROBE, 5_000))
    data[at] ^= change
    assert opened(bytes(data), lambda _: KEY) is None


@given(st.binary(max_size=2 * PACKET_BYTES))
def test_other_bytes_are_dropped(data: bytes) -> None:
    """A packet of any content and length raises nothing."""
    assert opened(data, lambda _: KEY) is None


@pytest.mark.parametrize("key", [None, b"", b"x" * 32])
def test_a_packet_under_another_key_is_dropped(key: bytes | None) -> None:
    """None: the receiver has no key for it."""
    assert opened(probe(KEY, 3, NONCE), lambda _: key) is None


def test_the_master_and_the_probed_slave_derive_the_same_key() -> None:
    """Another prober, or another probed host, has another key."""
    secret = ClusterSecret(b"s" * 32)
    grants = [Grant(Principal("host", name), Role.HOST, 1) for name in ("a", "b")]
    master = MasterSecurity(secret, grants)
    a, b = (MemberSecurity(secret.key_of(grant)) for grant in grants)
    peer = master.peer("host:a", 1)
    assert peer is not None
    assert a.link_key(7) == master.link_key_of(peer, 7)
    assert len({a.link_key(7), a.link_key(8), b.link_key(7)}) == 3
