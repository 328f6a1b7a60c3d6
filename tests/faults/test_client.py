"""A client whose master is killed during a request."""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Sequence

import pytest

from rosrm.errors import Refused
from rosrm.model.rows import ProcessRow
from rosrm.ros.control import accepted, refused
from rosrm.ros.master_connection import MasterClient, is_unsure
from tests.ros.clusters import host, job, service
from tests.waiting import PATIENCE


def test_the_outcome_of_a_request_to_a_killed_master_is_unsure(make_cluster) -> None:
    """The next run of the master executes the request, or rejects it as too old: then "unsure"."""
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
        client.submit([service("first")])  # the client has discovered the service from here on
        # However long that took, the client sends no greeting before the request.
        client._last_contact += 1000.0
        master = cluster.master.process
        master.send_signal(signal.SIGSTOP)  # the request arrives, and the master does not answer
        asking = threading.Thread(target=submit)
        asking.start()
        asking.join(1.0)
        cluster.restart_master()
        asking.join(PATIENCE)
    finally:
        client.close()
    assert said in (["unsure"], ["done"])


def test_a_request_to_another_run_of_the_master_is_repeated(make_cluster) -> None:
    """The former run never got the request, so the client that greeted that run repeats it."""
    cluster = make_cluster(host("h0"))
    with MasterClient.connect(cluster.ros, name="other", timeout=PATIENCE) as client:
        client.list()
        cluster.restart_master()
        cluster.wait_for_hosts()
        client._last_contact += 1000.0  # the client greeted the former run just now
        client.submit([service("p")])
        cluster.wait("p", "running")


def test_a_listing_and_a_log_are_read_across_restarts(make_cluster) -> None:
    """A request that only reads is sent to the next run of the master or slave at once."""
    cluster = make_cluster(host("h0"))
    cluster.run(job("speaks", "echo", "hello"))
    with MasterClient.connect(cluster.ros, name="other", timeout=PATIENCE) as client:
        assert client.read_log("h0", "speaks").content == b"hello\n"
        cluster.start_slave_again("h0")  # the client has a ticket for the former run
        assert client.read_log("h0", "speaks").content == b"hello\n"
        cluster.master.process.send_signal(signal.SIGSTOP)
        found: list[str] = []
        asking = threading.Thread(target=lambda: found.extend(row.name for row in _rows(client)))
        asking.start()
        asking.join(3.0)  # the client sends the request a second time
        cluster.restart_master()
        asking.join(PATIENCE)
    assert found == ["speaks"]


def test_a_request_to_a_killed_master_reports_its_wait_and_can_be_ended(make_cluster) -> None:
    """The caller learns every moment for how long it waits, and ends the request at once."""
    cluster = make_cluster(host("h0"))

    class Enough(Exception):
        pass

    def on_wait(seconds: float) -> None:
        waits.append(seconds)
        if seconds > 1.0:
            raise Enough

    waits: list[float] = []
    with MasterClient.connect(cluster.ros, name="other", timeout=PATIENCE) as client:
        client.list()
        cluster.master.process.kill()
        began = time.monotonic()
        with pytest.raises(Enough):
            client.list(on_wait=on_wait)
        assert time.monotonic() - began < PATIENCE / 2  # the request itself would take all of it
    assert len(waits) > 5


def _rows(client: MasterClient) -> Sequence[ProcessRow]:
    return client.list(processes=True).processes


@pytest.mark.parametrize(
    ("answer", "unsure"),
    [
        (accepted(epoch=2), False),  # done, by either run
        (refused("exists", "p is in use already", 1), False),  # by the run that was asked first
        (refused("exists", "p is in use already", 2), True),  # perhaps by its own first try
        (refused("stale", "too old"), True),
        (refused("invalid", "no such field"), False),  # independent of the run
    ],
)
def test_a_refusal_by_another_run_of_the_master_is_unsure(answer, unsure) -> None:
    """A repeated request may be refused because the former run has executed it."""
    assert is_unsure(answer, 1) is unsure
