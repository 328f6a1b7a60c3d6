"""Stops that processes cannot delay, with real processes."""

from __future__ import annotations

import pytest

from rosrm.errors import Refused
from rosrm.model.values import StopPolicy
from tests.ros.clusters import host, python

#: Ignores both signals before SIGKILL.
DEAF = """
import signal, time
for number in (signal.SIGINT, signal.SIGTERM):
    signal.signal(number, signal.SIG_IGN)
print("deaf", flush=True)
time.sleep(600)
"""


@pytest.fixture(scope="module")
def cluster(make_shared):
    return make_shared(host("h0"))


def test_an_operator_kills_what_ignores_its_stop(cluster) -> None:
    """The process has minutes to stop, and ends at once."""
    cluster.submit(python("deaf", DEAF, stop=StopPolicy(300.0, 300.0)))
    cluster.wait_for_log("deaf", "deaf")
    cluster.client.cancel(["deaf"])
    cluster.wait("deaf", "stopping")
    cluster.client.cancel(["deaf"], force=True)
    assert cluster.ended("deaf").state == "cancelled"


def test_a_process_that_would_stop_for_hours_is_refused(cluster) -> None:
    """Such a process would hold the stop of its slave."""
    with pytest.raises(Refused, match="600 s together"):
        cluster.submit(python("slow", DEAF, stop=StopPolicy(7_200_000.0)))
