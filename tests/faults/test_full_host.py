"""The disk on which a slave and its supervisor keep their state is full."""

from __future__ import annotations

import signal

import pytest

from rosrm.config.settings import LivenessSettings
from rosrm.model.values import RestartPolicy
from tests.faults.disks import small_disk
from tests.ros.clusters import PATIENCE, alive, clusters, host, job, service

LIVENESS = LivenessSettings(suspect=3.0, lease=60.0)


@pytest.fixture
def disk(tmp_path):
    """Where h0 keeps its state."""
    with small_disk(tmp_path / "c" / "hosts" / "h0") as disk:
        yield disk


@pytest.fixture
def cluster(disk, tmp_path):
    with clusters(lambda: tmp_path / "c") as make:
        yield make(host("h0"), liveness=LIVENESS)


def test_what_runs_goes_on_and_what_cannot_start_says_why(cluster, disk) -> None:
    """It is told with the process, by the file's name, in listings and events.

    By its policy it is tried again, and starts when there is room.
    """
    cluster.submit(service("runs"))
    pid = cluster.wait("runs", "running").pid
    disk.fill()
    again = RestartPolicy("on-failure", delay=0.5, attempts=1000)
    large = "x" * 20_000  # more than is left in the last page of the supervisor's record
    cluster.submit(job("once", "true", large), job("new", "true", large, restart=again))

    row = cluster.ended("once")
    assert row.state == "failed"
    for reason in (row.reason, cluster.wait("new", "backoff").reason):
        assert "No space left" in reason
        assert str(disk.place) in reason
    assert any("No space left" in event.message for event in cluster.events(process="once"))
    assert alive(pid)
    disk.make_room()
    assert cluster.ended("new", timeout=60.0).state == "finished"
    assert cluster.process("runs").pid == pid


def test_a_slave_starts_again_on_a_full_disk(cluster, disk) -> None:
    """It finds what its supervisor has kept."""
    cluster.submit(service("runs"))
    pid = cluster.wait("runs", "running").pid
    disk.fill()
    slave = cluster.slaves["h0"].process
    slave.send_signal(signal.SIGKILL)
    slave.wait(PATIENCE)
    cluster.start_slave_again(cluster.hosts[0].host)
    assert cluster.wait("runs", "running").pid == pid
    disk.make_room()
