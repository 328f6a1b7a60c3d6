"""Portable nodes that are dumped from time to time, and go on from there after a crash."""

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
    Ear,
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
def ear(cluster):
    ear = Ear(cluster.domain)
    yield ear
    ear.close()


@pytest.fixture
def running(criu, cluster, ear):
    """Starts a counter that is dumped each second; in the end nothing is left of it."""

    def start(**fields) -> None:
        arguments = fields.pop("arguments", ())
        cluster.submit(counter(*arguments, options={"checkpoint_every": 1.0}, **fields))
        cluster.wait(NAME, "running")
        ear.hear(10)

    yield start
    cluster.cancel(NAME)
    cluster.wait(NAME, "cancelled")
    nothing_left(cluster)
    wait_until(lambda: not images(cluster), f"no image left: {images(cluster)}")


def images(cluster) -> list[Path]:
    """Those that count."""
    return found_below(cluster, "periodic-*/*/rejoin.json")


def another_image(cluster) -> None:
    """Wait until one counts that did not until now."""
    before = images(cluster)
    wait_until(lambda: set(images(cluster)) - set(before), "another image")


def crash(cluster, ear: Ear) -> tuple[int, int]:
    """SIGKILL, and wait until it is heard again; the last count before and the first after it."""
    pid = cluster.process(NAME).pid
    os.kill(pid, signal.SIGKILL)
    wait_until(lambda: not Path(f"/proc/{pid}").exists(), "the end of the process")
    time_to_arrive(ear)
    last = len(ear.counts) - 1
    ear.hear(30, 60.0)
    return ear.counts[last], ear.counts[last + 1]


def time_to_arrive(ear: Ear) -> None:
    """What was sent before has been heard: nothing more comes."""
    seen = -1
    while seen != len(ear.counts):
        seen = len(ear.counts)
        time.sleep(0.1)


def is_up(row, restarts: int) -> bool:
    return (row.state, row.restarts) == ("running", restarts)


def after(cluster, what: str, condition: Callable[..., bool]):
    """The row of the process, once something holds of it."""
    view = cluster.wait_until(
        what, lambda view: any(row.name == NAME and condition(row) for row in view.processes), 60.0
    )
    return next(row for row in view.processes if row.name == NAME)


def test_a_crashed_node_goes_on_from_its_last_checkpoint(cluster, ear, running):
    """It has what it had then: the count and the memory; and the next crash begins later."""
    running()
    reached = 0
    for times in (1, 2):
        another_image(cluster)
        another_image(cluster)
        before, first = crash(cluster, ear)
        assert reached < first <= before + 1, (reached, first, before)
        reached = first
        row = after(cluster, f"restart {times}", lambda row, n=times: is_up(row, n))
        assert row.migrations == 0
    assert len(ear.checksums) == 1
    told = cluster.events("periodic_checkpoint", process=NAME)
    assert len(told) == 1
    assert "the first periodic checkpoint of" in told[0].message


def test_nobody_but_its_supervisor_is_needed(cluster, ear, running):
    """Slave and master are dead when it crashes; they find it again as it is."""
    running()
    another_image(cluster)
    pid, host = cluster.process(NAME).pid, cluster.process(NAME).host
    for part in (cluster.master, cluster.slaves[host]):
        part.process.kill()
        part.process.wait(PATIENCE)
    os.kill(pid, signal.SIGKILL)
    wait_until(lambda: not Path(f"/proc/{pid}").exists(), "the end of the process")
    time_to_arrive(ear)
    last = len(ear.counts) - 1
    ear.hear(30, 60.0)
    assert 1 < ear.counts[last + 1] <= ear.counts[last] + 1
    cluster.reconnect()
    cluster.start_master()
    cluster.start_slave(next(one for one in cluster.hosts if one.host == host))
    after(cluster, "the restart is known", lambda row: is_up(row, 1))
    another_image(cluster)


def test_it_goes_on_from_where_it_has_moved_to(cluster, ear, running):
    """Its images are those of the new host; those of the old one are gone."""
    running()
    another_image(cluster)
    source = cluster.process(NAME).host
    assert not ask(cluster)
    row = after(cluster, "the move", lambda row: row.migrations == 1 and row.state == "running")
    assert row.host != source
    another_image(cluster)
    ear.hear(10)
    wait_until(
        lambda: all(source not in path.parts for path in images(cluster)),
        f"no image on {source}",
    )
    before, first = crash(cluster, ear)
    assert 1 < first <= before + 1
    assert cluster.process(NAME).host == row.host


def test_who_is_restarted_by_hand_begins_anew(cluster, ear, running):
    """It is asked for where something is wrong: perhaps what it remembers."""
    running()
    another_image(cluster)
    ear.hear(100)
    cluster.client.restart([NAME])
    deadline = time.monotonic() + PATIENCE
    while min(ear.steps()) > 0:
        assert time.monotonic() < deadline, "it did not begin anew"
        ear.hear(1)
    first = next(after for before, after in pairwise(ear.counts) if after < before)
    assert first < 50
    another_image(cluster)


def test_no_count_is_lost_or_repeated_while_nothing_crashes(cluster, ear, running):
    """A reader that finds the new writer late may miss some; it hears none twice."""
    running()
    for _ in range(3):
        another_image(cluster)
    ear.hear(50)
    assert min(ear.steps()) == 1
    assert cluster.process(NAME).restarts == 0


def test_it_is_not_unhealthy_for_being_away(cluster, ear, running):
    """Each absence is longer than its topic may be silent."""
    running(health=Health("count", rate=5.0, timeout=0.5))
    for _ in range(3):
        another_image(cluster)
    row = cluster.process(NAME)
    assert (row.state, row.restarts) == ("running", 0)


def test_a_slave_is_killed_in_a_checkpoint(cluster, ear, running):
    """The next one has the node join again; its image before is still there."""
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
    ear.hear(50, 60.0)
    assert min(ear.steps()) == 1
    another_image(cluster)
    row = cluster.process(NAME)
    assert (row.state, row.restarts) == (InstanceState.RUNNING.value, 0)


def test_what_cannot_be_dumped_is_said_and_goes_on(cluster, ear, running):
    """Once, with the reason; it is tried again, and each time it counts on."""
    before = cluster.client.list().last_sequence  # of a test before this one, another may be there
    running(command=(sys.executable, TROUBLED), arguments=("pipe",))
    event = cluster.wait_for_event("periodic_failed", process=NAME, after=before, timeout=60.0)
    assert "no periodic checkpoint of portable_counter was made" in event.message
    assert "is a pipe that it shares with" in event.message
    ear.hear(150)
    assert min(ear.steps()) == 1
    assert images(cluster) == []
    assert len(cluster.events("periodic_failed", process=NAME, after=before)) == 1
