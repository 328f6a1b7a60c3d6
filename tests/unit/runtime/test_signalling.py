"""Signals to processes that have ended, and that belong to others."""

from __future__ import annotations

import os
import signal
import subprocess

import pytest

from rosrm.runtime.signalling import send, send_by, send_to_group


def test_an_ended_process_is_no_refusal():
    """Signals to an ended process by pid, group or descriptor return no reason."""
    process = subprocess.Popen(["sleep", "60"], start_new_session=True)
    descriptor = os.pidfd_open(process.pid)
    assert send_by(descriptor, signal.SIGKILL) == ""
    process.wait(10.0)
    assert send(process.pid, signal.SIGTERM) == ""
    assert send_to_group(process.pid, signal.SIGTERM) == ""
    assert send_by(descriptor, signal.SIGTERM) == ""
    os.close(descriptor)


def test_a_refusal_is_returned_with_its_reason(monkeypatch):
    """A process of another user ends no loop over many processes."""

    def refuse(_pid, _number):
        raise PermissionError(1, os.strerror(1))

    monkeypatch.setattr(os, "kill", refuse)
    assert send(1, signal.SIGTERM) == "Operation not permitted"


@pytest.mark.parametrize("pid", [0, -1])
def test_an_unknown_pid_reaches_no_other_process(monkeypatch, pid):
    """The system would signal the sender's group, or all processes."""
    sent: list[int] = []
    for name in ("kill", "killpg"):
        monkeypatch.setattr(os, name, lambda target, _: sent.append(target))
    assert "no pid" in send(pid, signal.SIGKILL)
    assert "no process group" in send_to_group(pid, signal.SIGKILL)
    assert sent == []
