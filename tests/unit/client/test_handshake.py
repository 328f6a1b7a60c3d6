"""Handshake of a client with a master that has just started."""

from __future__ import annotations

from types import SimpleNamespace

from rosrm.ros import master_connection
from rosrm.ros.master_connection import _LOOK, _ask_until_answered

GREETING = object()


class Network:
    """Fake participant and client; a second server, which answers, is discovered after a moment."""

    found_at = 0.05

    def __init__(self) -> None:
        self.now = 0.0
        self.sent: list[float] = []

    def boot_time(self) -> float:
        return self.now

    def spin(self, timeout: float) -> None:
        self.now += timeout

    def counted(self, take):
        return take

    def servers(self) -> int:
        return 1 + (self.now >= self.found_at)

    def call_async(self, _request):
        self.sent.append(self.now)
        future = SimpleNamespace(result=lambda: GREETING)
        answered = self.servers() == 2
        return SimpleNamespace(add_done_callback=lambda take: take(future) if answered else None)


def test_a_newly_discovered_server_gets_the_handshake_at_once(monkeypatch) -> None:
    """The service of a killed master looks ready, and the interval of repetitions is 0.5 s."""
    network = Network()
    monkeypatch.setattr(master_connection, "clocks", network)
    found = _ask_until_answered(
        network, network, object(), 10.0, 0.5, servers=network.servers, look=_LOOK
    )
    assert found.answer is GREETING
    assert len(network.sent) == 2
    assert network.sent[1] < network.found_at + 0.02
