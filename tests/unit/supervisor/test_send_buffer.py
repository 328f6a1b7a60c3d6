"""The send buffer when no further thread can be started."""

from __future__ import annotations

import socket

import pytest

from rosrm import threads
from rosrm.supervisor.send_buffer import Outgoing


def test_without_a_thread_the_peer_counts_as_gone(monkeypatch):
    """Otherwise each order would be queued, and no thread would send it."""

    def none(*_, **__):
        raise RuntimeError("can't start new thread")

    monkeypatch.setattr(threads, "start", none)
    ours, theirs = socket.socketpair()
    with theirs:
        outgoing = Outgoing(ours)
        with pytest.raises(OSError, match="can't start new thread"):
            outgoing.send(b"x" * (1 << 24))
        with pytest.raises(BrokenPipeError):
            outgoing.send(b"y")
        assert not outgoing.waits
        outgoing.close()
