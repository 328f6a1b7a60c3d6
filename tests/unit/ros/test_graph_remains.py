"""Sockets that a process still holds after leaving ROS: which are closed, which are reported."""

from __future__ import annotations

import ctypes
import socket

import pytest

from rosrm.errors import PortableError
from rosrm.ros import fast_dds_relocation
from rosrm.ros.graph_remains import close_leaked, open_sockets, what_is_left


@pytest.fixture
def make():
    """Create sockets, and close the remaining ones afterwards."""
    made = []

    def make(kind: int) -> socket.socket:
        made.append(socket.socket(socket.AF_INET, kind))
        return made[-1]

    yield make
    for one in made:
        if one.fileno() in open_sockets():
            one.close()
        else:
            one.detach()


def test_an_open_socket_is_named(make) -> None:
    """The error has its number and the remedy."""
    one = make(socket.SOCK_DGRAM)
    assert one.fileno() in open_sockets()
    assert f"{one.fileno()}" in what_is_left()
    assert "leave()" in what_is_left()


def test_unused_sockets_are_closed(make) -> None:
    """Fast DDS leaves UDP sockets that are neither bound nor connected."""
    number = make(socket.SOCK_DGRAM).fileno()
    close_leaked(open_sockets())
    assert number not in open_sockets()


def test_sockets_in_use_stay(make) -> None:
    """Bound and connected sockets, and other kinds, belong to the author of the node."""
    bound, connected, stream = (
        make(kind) for kind in (socket.SOCK_DGRAM, socket.SOCK_DGRAM, socket.SOCK_STREAM)
    )
    bound.bind(("127.0.0.1", 0))
    connected.connect(bound.getsockname())
    numbers = {one.fileno() for one in (bound, connected, stream)}
    close_leaked({number: one for number, one in open_sockets().items() if number in numbers})
    assert numbers <= set(open_sockets())


def test_a_number_that_is_another_socket_by_now_stays(make) -> None:
    """The recorded socket is gone, and its number was reused."""
    number = make(socket.SOCK_DGRAM).fileno()
    close_leaked({number: "socket:[1]"})
    assert number in open_sockets()


def test_a_fast_dds_that_cannot_rescan_is_refused(monkeypatch) -> None:
    """The error comes before the node leaves, not as a silent node after its move."""
    libc = ctypes.CDLL(None)
    monkeypatch.setattr(fast_dds_relocation, "_library", lambda: libc)
    for function in (fast_dds_relocation.check, fast_dds_relocation.look_again):
        with pytest.raises(PortableError, match=r"update_interfaces.*loopback alone"):
            function()


def test_interfaces_that_cannot_be_read_are_an_error(monkeypatch) -> None:
    """Otherwise no other participant would receive the node's messages."""
    monkeypatch.setattr(fast_dds_relocation, "_library", lambda: ctypes.CDLL(None))
    monkeypatch.setattr(fast_dds_relocation, "_interfaces_of", lambda _: lambda: False)
    with pytest.raises(PortableError, match="cannot read the network interfaces"):
        fast_dds_relocation.look_again()


def test_guids_that_cannot_be_renewed_are_reported(monkeypatch) -> None:
    """The loss is smaller: an image can then be restored only once."""
    monkeypatch.setattr(fast_dds_relocation, "_library", lambda: ctypes.CDLL(None))
    monkeypatch.setattr(fast_dds_relocation, "_interfaces_of", lambda _: lambda: True)
    assert fast_dds_relocation.look_again() is False


def test_without_fast_dds_there_is_nothing_to_renew(monkeypatch) -> None:
    """The library of another vendor detects the interfaces without help."""
    monkeypatch.setattr(fast_dds_relocation, "_library", lambda: None)
    fast_dds_relocation.check()
    assert fast_dds_relocation.look_again() is True
