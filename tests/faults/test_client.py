"""A client whose master is killed while it asks."""

from __future__ import annotations

import signal
import threading

import pytest

from rosrm.errors import Refused
from rosrm.ros.client import MasterClient, is_unsure
from rosrm.ros.control import accepted, refused
from tests.ros.clusters import PATIENCE, host, service


def test_what_a_killed_master_may_have_taken_is_not_called_undone(make_cluster) -> None:
    """The next run of the master does it, or takes it for too old: then nobody can tell."""
    cluster = make_cluster(host("h0"))
    cluster.client.list()
    client = MasterClient.connect(cluster.ros, name="other", timeout=PATIENCE)
    said: list[str] = []

    def submit() -> None:
        try:
            client.submit([service("p")])
        except Refused as refusal:
            said.append(refusal.code)
        else:
            said.append("done")

    try:
        client.submit([service("first")])  # the service is known from here on
        client._heard += 1000.0  # however long that took: it greets nobody before it asks
        master = cluster.master.process
        master.send_signal(signal.SIGSTOP)  # the request reaches it, and nobody answers
        asking = threading.Thread(target=submit)
        asking.start()
        asking.join(1.0)
        master.send_signal(signal.SIGKILL)
        master.wait(PATIENCE)
        cluster.reconnect()
        cluster.start_master()
        asking.join(PATIENCE)
    finally:
        client.close()
    assert said in (["unsure"], ["done"])


def test_a_request_to_another_run_of_the_master_is_made_anew(make_cluster) -> None:
    """It was not sent to the former one: a client that greeted that goes on by itself."""
    cluster = make_cluster(host("h0"))
    with MasterClient.connect(cluster.ros, name="other", timeout=PATIENCE) as client:
        client.list()
        cluster.master.process.send_signal(signal.SIGKILL)
        cluster.master.process.wait(PATIENCE)
        cluster.reconnect()
        cluster.start_master()
        cluster.wait_for_hosts()
        client._heard += 1000.0  # it greeted the former one just now
        client.submit([service("p")])
        cluster.wait("p", "running")


@pytest.mark.parametrize(
    ("answer", "unsure"),
    [
        (accepted(epoch=2), False),  # done, whoever did it
        (refused("exists", "p is in use already", 1), False),  # by the run that was asked first
        (refused("exists", "p is in use already", 2), True),  # perhaps by its own first asking
        (refused("stale", "too old"), True),
        (refused("invalid", "no such field"), False),  # says nothing of a run: of the request alone
    ],
)
def test_a_refusal_by_another_run_of_the_master_leaves_it_open_what_was_done(
    answer, unsure
) -> None:
    """A repeated request may be turned down for what the former run has done of it."""
    assert is_unsure(answer, 1) is unsure
