"""Events that cross: the supervisor was stopped or busy, and several are there at once."""

from __future__ import annotations

import contextlib
import os
import signal
from collections.abc import Iterator

import pytest

from rosrm.core.supervisor.events import StopOrdered
from rosrm.core.supervisor.instance import RUNNING, STOPPING, Instance
from rosrm.core.supervisor.rules import RestartRule, StopRule
from rosrm.supervisor import endpoint, messages, procfs
from rosrm.supervisor.logs import LogLimits
from rosrm.supervisor.server import Server
from tests.waiting import PATIENCE, command_of, wait_until

KEY = ("sleeps", 1)


@contextlib.contextmanager
def stopped(pid: int) -> Iterator[None]:
    """Stop a process in this context."""
    os.kill(pid, signal.SIGSTOP)
    try:
        wait_until(lambda: procfs.read_stat(pid).state == "T", "the stop")
        yield
    finally:
        os.kill(pid, signal.SIGCONT)


def test_a_client_may_leave_while_the_next_one_is_welcomed(host, client):
    """The welcome finds that the former client is gone; the event of that client comes next."""
    peer = endpoint.connect(str(host.state), 5.0)
    host.sleeper(client, "sleeps")  # the connection is accepted before
    with peer, stopped(client.pid):
        peer.sendall(messages.encode_order(messages.Hello(messages.PROTOCOL, 1, LogLimits())))
        client.close()
        os.kill(client.pid, signal.SIGCONT)
        assert b"welcome" in peer.recv(1 << 16)
    assert host.connect().pid == client.pid


class _Begun:
    """A server of this very process, with a start whose program runs, which it has not noticed."""

    def __init__(self, state: str) -> None:
        self.server = Server(state, endpoint.listen(state), LogLimits())
        self.server._environments["all"] = dict(os.environ)
        launch = messages.Launch(KEY, ("sleep", "1000"), "all", {}, None, RestartRule(), StopRule())
        self.server._start(launch)
        self.server._round()
        (start,) = self.server._starts.values()
        self.pid = start.attempt.pid
        wait_until(lambda: command_of(self.pid).startswith("sleep"), "the program")

    def look(self) -> Instance:
        """Return the instance after the next round of the server."""
        self.server._round()
        self.server._take_in(PATIENCE)
        return self.server._core.instances[KEY]


@pytest.fixture
def begun(tmp_path):
    begun = _Begun(str(tmp_path / "state"))
    yield begun
    os.kill(begun.pid, signal.SIGKILL)
    os.waitpid(begun.pid, 0)


def test_a_program_that_runs_is_not_late(begun):
    """The supervisor was stopped, or the machine suspended, for longer than a start may take."""
    (start,) = begun.server._starts.values()
    start.due = start.late = 0.0
    assert begun.look().phase == RUNNING
    assert procfs.read_stat(begun.pid).alive


def test_a_program_that_runs_is_stopped_as_any_other(begun):
    """An order to stop that comes before the notice of the start kills no program at once."""
    begun.server._happened(StopOrdered(KEY))
    instance = begun.look()
    assert (instance.phase, instance.pid) == (STOPPING, begun.pid)
