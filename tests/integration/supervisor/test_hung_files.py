"""A file system that does not answer delays only the process that names a path on it."""

from __future__ import annotations

import os
import signal

import pytest

from rosrm.core.supervisor.events import ShutdownOrdered, StopOrdered
from rosrm.model.values import InstanceState, RestartPolicy
from tests.hung_files import hung_files
from tests.waiting import command_of, wait_gone, wait_until

SLEEPER = b"#!/bin/sh\nexec sleep 1000\n"


@pytest.fixture
def hung(tmp_path):
    with hung_files(tmp_path / "hung", {"program": SLEEPER, "secret": b"x"}) as files:
        yield files


def options_of(kind: str, place) -> tuple[tuple[str, ...], dict]:
    """Return command and options of an order that names a path on the file system."""
    if kind == "program":
        return (f"{place}/program",), {}
    if kind == "directory":
        return ("sleep", "1000"), {"working_directory": str(place)}
    if kind == "PATH":
        return ("program",), {"environment": {"PATH": f"{place}:{os.environ['PATH']}"}}
    return ("sleep", "1000"), {"secrets": {"PASSWORD": f"{place}/secret"}}


@pytest.mark.parametrize("kind", ["program", "directory", "PATH", "secret"])
def test_others_are_managed_while_a_path_does_not_answer(host, hung, kind):
    """Others start, restart and stop; the one that waits fails with the path as its reason."""
    client = host.connect()
    hung.hang()
    argv, options = options_of(kind, hung.place)
    client.start([host.order("waits", *argv, **options)])
    client.start([host.order("other", "sleep", "1000", restart=RestartPolicy("always"))])
    os.kill(host.running(client, "other").pid, signal.SIGKILL)
    assert host.running(client, "other").restarts == 1
    client.send(StopOrdered(("other", 1)))
    assert host.ended(client, "other").state is InstanceState.EXITED
    failed = host.ended(client, "waits")
    assert failed.state is InstanceState.FAILED
    assert str(hung.place) in failed.message
    assert "does not answer" in failed.message


def test_a_start_that_waits_for_a_path_is_cancelled_at_once(host, hung):
    """The process that waits ends later; until then no other one of its name is started."""
    client = host.connect()
    hung.hang()
    for number in (1, 2):
        order = host.order("waits", f"{hung.place}/program", number=number)
        client.start([order])
        if number == 1:
            wait_until(lambda: hung.unanswered, "a request of the start")
            client.send(StopOrdered(("waits", 1)))
            assert host.ended(client, "waits").state is InstanceState.EXITED
    assert "an earlier start of it still waits" in host.ended(client, "waits", number=2).message


def test_a_process_that_crashes_as_its_disk_hangs_holds_up_no_other(host, hung):
    """The restart waits for the program, which worked at the first start."""
    client = host.connect()
    client.start([host.order("waits", f"{hung.place}/program", restart=RestartPolicy("always"))])
    pid = host.running(client, "waits").pid
    wait_until(lambda: command_of(pid).startswith("sleep"), "the shell has read the program")
    hung.hang()
    os.kill(pid, signal.SIGKILL)
    host.wait(client, "waits", InstanceState.STARTING, InstanceState.BACKOFF)
    assert host.sleeper(client, "other")


def test_the_supervisor_ends_and_is_replaced_while_a_start_waits(host, hung):
    """The process that waits holds neither the lock nor the socket of the supervisor."""
    client = host.connect()
    hung.hang()
    client.start([host.order("waits", "sleep", "1", working_directory=str(hung.place))])
    wait_until(lambda: hung.unanswered, "a request of the start")
    client.send(ShutdownOrdered())
    wait_gone(client.pid)
    assert host.sleeper(host.connect(), "other")
