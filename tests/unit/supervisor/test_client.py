"""The slave's side of the supervisor connection, without a supervisor process."""

from __future__ import annotations

import contextlib
import errno
import socket
import subprocess
import time
from pathlib import Path

import pytest

from rosrm.core.supervisor.events import ContactReported
from rosrm.errors import SupervisorError
from rosrm.supervisor import endpoint, messages
from rosrm.supervisor.client import (
    SupervisorClient,
    SupervisorEnded,
    SupervisorGone,
    SupervisorSilent,
)


def test_a_supervisor_that_ended_beside_an_order_has_ended(tmp_path: Path) -> None:
    """An unread order breaks the connection; that counts as an end, not as a crash."""
    ours, its = socket.socketpair()
    with SupervisorClient(ours, tmp_path) as client:
        client.send(ContactReported(1.0, 1.0))
        its.sendall(messages.encode_ended())
        its.close()
        with pytest.raises(SupervisorEnded):
            client.receive(5.0)


def test_a_stopped_supervisor_with_a_full_queue_is_silent(tmp_path: Path) -> None:
    """Earlier clients filled the queue of its socket, so the kernel makes a connect wait."""
    with contextlib.ExitStack() as waiting:
        waiting.enter_context(endpoint.listen(str(tmp_path)))
        with contextlib.suppress(TimeoutError):
            while True:
                waiting.enter_context(endpoint.connect(str(tmp_path), 0.05))
        began = time.monotonic()
        with pytest.raises(SupervisorSilent, match="did not answer in time"):
            SupervisorClient.connect(tmp_path, timeout=0.3)
        assert time.monotonic() - began < 5.0


def test_a_connection_closed_by_another_thread_is_gone(tmp_path: Path) -> None:
    """The slave ends while its receiving thread is between two waits."""
    ours, its = socket.socketpair()
    with its, SupervisorClient(ours, tmp_path) as client:
        client.close()
        with pytest.raises(SupervisorGone):
            client.receive(5.0)


def test_a_supervisor_that_cannot_be_forked_is_an_error_with_a_reason(tmp_path, monkeypatch):
    """Any other exception would end the thread that replaces it, and the slave would hang."""

    def fail(*_, **__):
        raise OSError(errno.EAGAIN, "Resource temporarily unavailable")

    monkeypatch.setattr(subprocess, "Popen", fail)
    with pytest.raises(SupervisorError, match=r"did not start: .* temporarily unavailable"):
        SupervisorClient.connect(tmp_path / "state")
