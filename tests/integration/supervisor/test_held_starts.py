"""Held starts of real processes: also without a slave, and after a kill of the supervisor."""

from __future__ import annotations

import pytest

from rosrm.core.supervisor.events import StopOrdered
from rosrm.model.values import InstanceState
from tests.waiting import wait_until

from .conftest import kill


def held(host, client):
    """Start a process that sleeps, hand over the start of another one; return the first pid."""
    pid = host.sleeper(client, "first")
    client.start([host.order("next", "sh", "-c", "echo ran", slots=1)])
    host.wait(client, "next", InstanceState.HELD)
    return pid


@pytest.mark.parametrize("supervised", [True, False], ids=["no slave", "no supervisor"])
def test_a_held_process_starts_if_its_slot_became_free_without_slave_or_supervisor(
    host, client, supervised
):
    """The supervisor needs no slave for the start; the next supervisor finds the free slot."""
    pid = held(host, client)
    client.close() if supervised else host.kill_supervisor(client)
    kill(pid)
    client = host.connect()
    assert host.ended_after_connect(client, "next").exit_code == 0
    assert host.log("next").read_text() == "ran\n"


def test_a_held_process_starts_after_a_take_over(host, client):
    """The next supervisor holds the start as before, and begins it once."""
    pid = held(host, client)
    client = host.replace_supervisor(client)
    found = {status.instance.process: status.state for status in client.instances}
    assert found == {"first": InstanceState.RUNNING, "next": InstanceState.HELD}
    kill(pid)
    assert host.ended(client, "next").exit_code == 0
    assert host.log("next").read_text() == "ran\n"


@pytest.mark.parametrize("replaced", [False, True], ids=["same supervisor", "next supervisor"])
def test_a_held_process_that_was_stopped_never_starts(host, client, replaced):
    """The final status shows a run time of 0, and the log that was made ahead is removed."""
    pid = held(host, client)
    wait_until(host.log("next").exists, "the log of the held process")
    client = host.replace_supervisor(client) if replaced else client
    client.send(StopOrdered(("next", 1)))
    assert host.ended(client, "next").run_time == 0.0
    kill(pid)
    host.ended(client, "first")
    assert not host.log("next").exists()
