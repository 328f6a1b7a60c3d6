"""Periodic checkpoints of portable nodes, and restarts from them after a crash."""

from __future__ import annotations

import os
import signal
import sys
import time
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import pytest

from rosrm.config.settings import CheckpointPolicySettings
from rosrm.model.values import Health, InstanceState
from tests.ros.clusters import PATIENCE, wait_until
from tests.ros.portable_kit import (
    NAME,
    Listener,
    ask,
    counter,
    found_below,
    nothing_left,
    two_hosts,
)

pytestmark = pytest.mark.timeout(180)


TROUBLED = str(Path(__file__).parent / "programs/troubled.py")


@pytest.fixture(scope="module")
def cluster(make_shared):
    return two_hosts(make_shared, checkpoint=CheckpointPolicySettings(options={"away": 0.4}))


@pytest.fixture
def listener(cluster):
    listener = Listener(cluster.domain)
    yield listener
    listener.close()


@pytest.fixture
def running(criu, cluster, listener):
    """Yield a function that starts a counter dumped each second; remove all of it at the end."""

    def start(**fields) -> None:
        arguments = fields.pop("arguments", ())
        cluster.submit(counter(*arguments, options={"checkpoint_every": 1.0}, **fields))
        cluster.wait(NAME, "running")
        listener.receive(10)

    yield start
    cluster.cancel(NAME)
    cluster.wait(NAME, "cancelled")
    nothing_left(cluster)
    wait_until(lambda: not images(cluster), f"no image left: {images(cluster)}")


def images(cluster) -> list[Path]:
    """Return the complete images."""
    return found_below(cluster, "periodic-*/*/rejoin.json")


def another_image(cluster) -> None:
    """Wait until a further image is complete."""
    before = images(cluster)
    wait_until(lambda: set(images(cluster)) - set(before), "another image")


def crash(cluster, listener: Listener) -> tuple[int, int]:
    """Kill the process; return the last count before its restart and the first one after."""
    pid = cluster.process(NAME).pid
    os.kill(pid, signal.SIGKILL)
    wait_until(lambda: not Path(f"/proc/{pid}").exists(), "the end of the process")
    receive_pending(listener)
    last = len(listener.counts) - 1
    listener.receive(30, 60.0)
    return listener.counts[last], listener.counts[last + 1]


def receive_pending(listener: Listener) -> None:
    """Wait until no further count arrives."""
    seen = -1
    while seen != len(listener.counts):
        seen = len(listener.counts)
        time.sleep(0.1)


def is_up(row, restarts: int) -> bool:
    return (row.state, row.restarts) == ("running", restarts)


def after(cluster, what: str, condition: Callable[..., bool]):
    """Wait for a condition of the process, and return its row."""
    view = cluster.wait_until(
        what, lambda view: any(row.name == NAME and condition(row) for row in view.processes), 60.0
    )
    return next(row for row in view.processes if row.name == NAME)


def test_a_crashed_node_continues_from_its_last_checkpoint(cluster, listener, running):
    """Count and memory are those of the checkpoint; a second crash continues from a later one."""
    running()
    reached = 0
    for times in (1, 2):
        another_image(cluster)
        another_image(cluster)
        before, first = crash(cluster, listener)
        assert reached < first <= before + 1, (reached, first, before)
        reached = first
        row = after(cluster, f"restart {times}", lambda row, n=times: is_up(row, n))
        assert row.migrations == 0
    assert len(listener.checksums) == 1
    (event,) = cluster.events("periodic_checkpoint", process=NAME)
    assert "the first periodic checkpoint of" in event.message


def test_the_supervisor_alone_restarts_from_a_checkpoint(cluster, listener, running):
    """Slave and master are killed before the crash; after their restart they report the process."""
    running()
    another_image(cluster)
    pid, host = cluster.process(NAME).pid, cluster.process(NAME).host
    for part in (cluster.master, cluster.slaves[host]):
        part.process.kill()
        part.process.wait(PATIENCE)
    os.kill(pid, signal.SIGKILL)
    wait_until(lambda: not Path(f"/proc/{pid}").exists(), "the end of the process")
    receive_pending(listener)
    last = len(listener.counts) - 1
    listener.receive(30, 60.0)
    assert 1 < listener.counts[last + 1] <= listener.counts[last] + 1
    cluster.reconnect()
    cluster.start_master()
    cluster.start_slave(next(one for one in cluster.hosts if one.host == host))
    after(cluster, "the restart is known", lambda row: is_up(row, 1))
    another_image(cluster)


def test_a_node_that_migrated_restarts_from_images_of_its_new_host(cluster, listener, running):
    """The images on the former host are removed."""
    running()
    another_image(cluster)
    source = cluster.process(NAME).host
    assert not ask(cluster)
    row = after(cluster, "the move", lambda row: row.migrations == 1 and row.state == "running")
    assert row.host != source
    another_image(cluster)
    listener.receive(10)
    wait_until(
        lambda: all(source not in path.parts for path in images(cluster)),
        f"no image on {source}",
    )
    before, first = crash(cluster, listener)
    assert 1 < first <= before + 1
    assert cluster.process(NAME).host == row.host


def test_a_restart_by_request_starts_without_a_checkpoint(cluster, listener, running):
    """A user requests a restart because of a fault, which may lie in the stored memory."""
    running()
    another_image(cluster)
    listener.receive(100)
    cluster.client.restart([NAME])
    deadline = time.monotonic() + PATIENCE
    while min(listener.steps()) > 0:
        assert time.monotonic() < deadline, "no count was lower than the one before"
        listener.receive(1)
    first = next(after for before, after in pairwise(listener.counts) if after < before)
    assert first < 50
    another_image(cluster)


def test_periodic_checkpoints_lose_and_repeat_no_count(cluster, listener, running):
    """A reader that discovers the new writer late may miss some; it receives none twice."""
    running()
    for _ in range(3):
        another_image(cluster)
    listener.receive(50)
    assert min(listener.steps()) == 1
    assert cluster.process(NAME).restarts == 0


def test_the_absence_for_a_checkpoint_is_not_unhealthy(cluster, listener, running):
    """Each absence is longer than the time-out of the health check."""
    running(health=Health("count", rate=5.0, timeout=0.5))
    for _ in range(3):
        another_image(cluster)
    row = cluster.process(NAME)
    assert (row.state, row.restarts) == ("running", 0)


def test_a_node_rejoins_after_its_slave_was_killed_in_a_checkpoint(cluster, listener, running):
    """The next slave lets the node rejoin the graph; the image before it is still complete."""
    running()
    another_image(cluster)
    host = cluster.process(NAME).host

    def away() -> list[Path]:
        return found_below(cluster, "periodic-*/away")

    deadline = time.monotonic() + PATIENCE
    while not away():
        assert time.monotonic() < deadline, "no checkpoint"
        time.sleep(0.001)
    cluster.slaves[host].process.kill()
    cluster.slaves[host].process.wait(PATIENCE)
    assert images(cluster)
    cluster.start_slave(next(one for one in cluster.hosts if one.host == host))
    listener.receive(50, 60.0)
    assert min(listener.steps()) == 1
    another_image(cluster)
    row = cluster.process(NAME)
    assert (row.state, row.restarts) == (InstanceState.RUNNING.value, 0)


def test_a_failed_periodic_checkpoint_is_recorded_once_and_retried(cluster, listener, running):
    """The record gives the reason; the node keeps counting."""
    before = cluster.client.list().last_sequence  # of a test before this one, another may be there
    running(command=(sys.executable, TROUBLED), arguments=("pipe",))
    event = cluster.wait_for_event("periodic_failed", process=NAME, after=before, timeout=60.0)
    assert "no periodic checkpoint of portable_counter was made" in event.message
    assert "is a pipe that it shares with" in event.message
    listener.receive(150)
    assert min(listener.steps()) == 1
    assert images(cluster) == []
    assert len(cluster.events("periodic_failed", process=NAME, after=before)) == 1
