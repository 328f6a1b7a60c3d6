"""Socket of the master for requests of its own machine: frames, bounds, and clients that fail."""

from __future__ import annotations

import os
import socket
import threading
from types import SimpleNamespace

import pytest

from rosrm import clocks
from rosrm.keys.cluster import ClusterSecret, own_grant
from rosrm.keys.roles import Principal
from rosrm.keys.security import MasterSecurity, MemberSecurity, NoSecurity
from rosrm.model.ros_settings import RosSettings
from rosrm.ros import master_socket
from rosrm.ros.master import request_socket
from rosrm.ros.master.request_socket import RequestSocket
from rosrm.ros.sealed_codec import Envelope
from tests.waiting import PATIENCE, wait_until

SERVICE = "/rosrm/list"
ENVELOPE = Envelope(1, "user:ada", 0, b"r" * 16, b"m" * 16, 7, b"body")
SETTINGS = RosSettings(domain=7)


class Side:
    """The side of a master, whose only service answers with the request and more bytes."""

    def __init__(self) -> None:
        self.security = SimpleNamespace(cluster=os.urandom(16))
        self.address = master_socket.address(SETTINGS, self.security)
        self.more, self.taken = b"", []
        post = lambda call, *arguments: call(*arguments)  # noqa: E731 - stands for the loop
        participant = SimpleNamespace(settings=SETTINGS, post=post)
        self.endpoints = SimpleNamespace(
            participant=participant, security=self.security, handlers={SERVICE: self.take}
        )

    def take(self, envelope, send) -> None:
        self.taken.append(envelope)
        if envelope is not None:
            send(envelope._replace(body=bytes(envelope.body) + self.more))

    def connect(self) -> socket.socket:
        return wait_until(lambda: master_socket.connect(self.address), "a free connection")

    def ask(self, seconds: float = PATIENCE) -> Envelope | None:
        """Return the answer to a genuine request."""
        with self.connect() as connection:
            request = master_socket.request_of(SERVICE, ENVELOPE)
            return master_socket.ask(connection, request, clocks.boot_time() + seconds, None)


@pytest.fixture
def side(monkeypatch):
    """Yield the side of a master that listens, with shorter times."""
    monkeypatch.setattr(request_socket, "_TRANSFER", 0.3)
    monkeypatch.setattr(request_socket, "_DECISION", 0.3)
    side = Side()
    with RequestSocket(side.endpoints):
        yield side


def test_a_request_is_answered_through_the_socket(side: Side) -> None:
    """A large answer arrives whole."""
    side.more = bytes(1 << 22)
    answer = side.ask()
    assert answer == ENVELOPE._replace(body=b"body" + side.more)


@pytest.mark.parametrize(
    "sent",
    [
        b"", b"\x01", b"\xff\xff\xff\xff", b"\x01\0\x10\0", b"\x05\0\0\0ab",
        b"\x04\0\0\0abcd", b"\x10\0\0\0/rosrm/nothing\0x", os.urandom(3000),
    ],
    ids=["nothing", "half a length", "4 GiB", "1 more than allowed", "half a frame",
         "no service", "an unknown service", "random bytes"],
)  # fmt: skip
def test_a_hostile_frame_is_dropped(side: Side, sent: bytes) -> None:
    """The master closes its connection in time, and answers others; no service gets the frame."""
    hostile = [side.connect() for _ in range(request_socket._THREADS - 1)]
    for one in hostile:
        one.sendall(sent)
    assert side.ask() == ENVELOPE
    for one in hostile:
        with one:
            one.settimeout(PATIENCE)
            assert _end_of(one) == b""
    assert side.taken == [ENVELOPE]


def _end_of(connection: socket.socket) -> bytes:
    try:
        return connection.recv(1)
    except ConnectionResetError:  # closed before all was read
        return b""


def test_a_malformed_envelope_reaches_its_service_as_such(side: Side) -> None:
    """The service counts it, as it does a malformed one over DDS, and does not answer."""
    with side.connect() as connection:
        request = SERVICE.encode() + b"\0" + b"no envelope"
        assert master_socket.ask(connection, request, clocks.boot_time() + PATIENCE, None) is None
    assert side.taken == [None]


def test_a_client_with_one_connection_too_many_has_none(side: Side) -> None:
    """The client then uses DDS; once the silent clients are dropped, the socket is free again."""
    silent = []
    while (one := master_socket.connect(side.address)) is not None:
        silent.append(one)
        assert len(silent) <= 3 * request_socket._THREADS
    assert len(silent) >= request_socket._THREADS
    for one in silent:
        one.close()
    assert side.ask() == ENVELOPE


def test_a_client_that_does_not_read_holds_up_no_other(side: Side) -> None:
    """Its answer does not fit into the buffer of the kernel."""
    side.more = bytes(1 << 22)
    with side.connect() as slow:
        master_socket.send(
            slow, master_socket.request_of(SERVICE, ENVELOPE), clocks.boot_time() + PATIENCE
        )
        wait_until(lambda: side.taken, "the request of the slow client")
        side.more = b""
        assert side.ask() == ENVELOPE


def test_a_request_without_an_answer_ends_at_its_time(side: Side, monkeypatch) -> None:
    """`on_wait` gets the seconds since the request."""
    monkeypatch.setattr(request_socket, "_DECISION", PATIENCE)
    late = []
    side.endpoints.handlers[SERVICE] = lambda _, send: late.append(send)
    waits: list[float] = []
    with side.connect() as connection:
        request = master_socket.request_of(SERVICE, ENVELOPE)
        until = clocks.boot_time() + 0.35
        assert master_socket.ask(connection, request, until, waits.append) is None
        assert clocks.boot_time() >= until
    late.pop()(ENVELOPE)  # ends the wait of the thread
    assert waits
    assert waits == sorted(waits)


def test_a_fault_ends_no_thread(side: Side, caplog) -> None:
    """Otherwise each fault would leave one thread less for other requests."""
    works, side.endpoints.participant.post = side.endpoints.participant.post, lambda *_: 1 / 0
    for _ in range(request_socket._THREADS):
        assert side.ask() is None
    side.endpoints.participant.post = works
    assert side.ask() == ENVELOPE
    assert "a request on the socket of this machine has failed" in caplog.text


def test_a_name_in_use_is_left_to_its_owner(side: Side, caplog) -> None:
    """A second master logs that, and the first one is still asked."""
    with RequestSocket(side.endpoints):
        assert side.ask() == ENVELOPE
    assert side.ask() == ENVELOPE
    assert "because the socket cannot be bound: Address already in use" in caplog.text


def test_after_the_end_nobody_listens_and_no_thread_is_left() -> None:
    """Also a socket that never listened can be closed."""
    side = Side()
    with RequestSocket(side.endpoints):
        assert side.ask() == ENVELOPE
    assert master_socket.connect(side.address) is None
    names = lambda: [one for one in threading.enumerate() if one.name.startswith("requests-")]  # noqa: E731
    wait_until(lambda: not names(), "the end of the threads", seen=names)
    side.endpoints.security = NoSecurity()
    with RequestSocket(side.endpoints):
        pass


def test_without_keys_there_is_no_socket() -> None:
    """Anyone could bind its name, and answer requests."""
    assert master_socket.address(SETTINGS, NoSecurity()) == ""
    assert master_socket.connect("") is None


def test_master_and_user_of_a_cluster_have_the_same_address(monkeypatch) -> None:
    """Masters that DDS keeps apart have different addresses, and no address discloses a key."""
    secret = ClusterSecret(os.urandom(32))
    key = secret.key_of(own_grant(Principal("user", "ada")))
    found = master_socket.address(SETTINGS, MasterSecurity(secret))
    assert found == master_socket.address(SETTINGS, MemberSecurity(key))
    assert key.master.hex() not in found
    others = [
        RosSettings(domain=8), RosSettings(domain=7, namespace="/other"),
        RosSettings(domain=7, interface="lo"), RosSettings(domain=7, discovery_range="off"),
        RosSettings(domain=7, discovery_server="desk:11811"),
    ]  # fmt: skip
    addresses = {master_socket.address(one, MemberSecurity(key)) for one in others}
    foreign = MasterSecurity(ClusterSecret(os.urandom(32)))
    assert len(addresses | {found, master_socket.address(SETTINGS, foreign)}) == len(others) + 2
    monkeypatch.setenv("ROS_DOMAIN_ID", "7")
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    monkeypatch.setenv("RMW_IMPLEMENTATION", "rmw_fastrtps_cpp")  # as without the variable
    monkeypatch.setenv("ROS_DISCOVERY_SERVER", "")
    assert found == master_socket.address(RosSettings(), MemberSecurity(key))
