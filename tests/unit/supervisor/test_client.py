"""The slave's side of the supervisor connection, tested with a socket pair."""

from __future__ import annotations

import socket
from pathlib import Path

import pytest

from rosrm.core.supervisor.events import ContactReported
from rosrm.supervisor import messages
from rosrm.supervisor.client import SupervisorClient, SupervisorEnded


def test_a_supervisor_that_ended_beside_an_order_has_ended(tmp_path: Path) -> None:
    """An unread order breaks the connection; that counts as an end, not as a crash."""
    ours, its = socket.socketpair()
    with SupervisorClient(ours, tmp_path) as client:
        client.send(ContactReported(1.0, 1.0))
        its.sendall(messages.encode_ended())
        its.close()
        with pytest.raises(SupervisorEnded):
            client.receive(5.0)
