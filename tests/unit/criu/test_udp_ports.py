"""Reservation of the UDP ports of a checkpointed process."""

from __future__ import annotations

import os
import socket

import pytest

from rosrm_criu.engine import udp_ports


@pytest.fixture
def ours():
    """Yield a UDP socket of this process, bound like one of Fast DDS."""
    one = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    one.bind(("127.0.0.1", 0))
    yield one
    one.close()


def bind(port: int, *, shared: bool) -> None:
    """Bind the port for a moment; raise OSError if it is in use."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as one:
        if shared:
            one.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        one.bind(("127.0.0.1", port))


def test_the_ports_of_a_process_are_seen(ours):
    """Bound ports are listed with their addresses, for IPv4 and IPv6."""
    with socket.socket(socket.AF_INET6, socket.SOCK_DGRAM) as other:
        other.bind(("::1", 0))
        found = udp_ports.bound([os.getpid()])
        assert (socket.AF_INET, "127.0.0.1", ours.getsockname()[1]) in found
        assert (socket.AF_INET6, "::1", other.getsockname()[1]) in found
    assert udp_ports.bound([2**22 + 1]) == []


def test_a_reserved_port_is_for_who_shares_it_alone(ours):
    """A reserved port admits sockets with SO_REUSEADDR, like CRIU's, but no new participant."""
    port = ours.getsockname()[1]
    ports = [one for one in udp_ports.bound([os.getpid()]) if one.port == port]
    ours.close()
    held = udp_ports.reserve(ports)
    try:
        with pytest.raises(OSError, match="in use"):
            bind(port, shared=False)
        bind(port, shared=True)
    finally:
        for one in held:
            one.close()
    bind(port, shared=False)


def test_a_port_that_is_in_use_is_left_alone(ours):
    """A port in use is not reserved, and causes no error before the restore."""
    port = udp_ports.Port(socket.AF_INET, "127.0.0.1", ours.getsockname()[1])
    assert udp_ports.reserve([port]) == []


def test_ports_are_remembered_and_what_cannot_be_read_is_none(tmp_path):
    """A missing or damaged file of ports counts as no ports, so that the restore can proceed."""
    path, ports = tmp_path / "kept-1.ports", [udp_ports.Port(socket.AF_INET, "0.0.0.0", 7412)]
    udp_ports.write(path, ports)
    assert udp_ports.read(path) == ports
    path.write_text("[[1]]", encoding="utf-8")
    assert udp_ports.read(path) == []
    assert udp_ports.read(tmp_path / "none") == []
