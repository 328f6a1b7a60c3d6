"""A full disk under the state of a slave and its supervisor, or under all that a robot writes."""

from __future__ import annotations

from contextlib import ExitStack

import pytest

from rosrm.config.settings import LivenessSettings
from rosrm.model.values import RestartPolicy
from tests.faults.disks import small_disk
from tests.ros.clusters import PATIENCE, alive, clusters, host, job, service

LIVENESS = LivenessSettings(suspect=3.0, lease=60.0)


@pytest.fixture
def disk(tmp_path):
    """Mount a small disk at the state directory of h0."""
    with small_disk(tmp_path / "c" / "hosts" / "h0") as disk:
        yield disk


@pytest.fixture
def cluster(disk, tmp_path):
    with clusters(lambda: tmp_path / "c") as make:
        yield make(host("h0"), liveness=LIVENESS)


def test_a_start_that_cannot_be_recorded_fails_with_the_reason(cluster, disk) -> None:
    """Listings and events of the process name the file that cannot be written.

    The restart policy retries the start, which succeeds when there is room.
    """
    cluster.submit(service("runs"))
    pid = cluster.wait("runs", "running").pid
    disk.fill()
    again = RestartPolicy("on-failure", delay=0.5, attempts=1000)
    large = "x" * 20_000  # larger than the free part of the last page of the supervisor's record
    cluster.submit(job("once", "true", large), job("new", "true", large, restart=again))

    row = cluster.ended("once")
    assert row.state == "failed"
    for reason in (row.reason, cluster.wait("new", "backoff").reason):
        assert "No space left" in reason
        assert "STATE/instances.jsonl" in reason
        assert str(disk.place) not in reason
    assert any("No space left" in event.message for event in cluster.events(process="once"))
    assert alive(pid)
    disk.make_room()
    assert cluster.ended("new", timeout=60.0).state == "finished"
    assert cluster.process("runs").pid == pid


def test_a_slave_starts_again_on_a_full_disk(cluster, disk) -> None:
    """A slave restarted on a full disk finds the processes in its supervisor's record."""
    cluster.submit(service("runs"))
    pid = cluster.wait("runs", "running").pid
    disk.fill()
    cluster.start_slave_again("h0")
    assert cluster.wait("runs", "running").pid == pid
    cluster.wait_for_event("plugin_failed", "written to the state directory: No space left")
    disk.make_room()
    cluster.wait_for_event("plugin_works", "state directory")


def test_one_disk_for_all_that_a_robot_writes(tmp_path, monkeypatch) -> None:
    """State of master and host, logs, /tmp and work: no part ends, and no exit code is lost."""
    with small_disk(tmp_path / "robot", size="16m") as disk, ExitStack() as opened:
        for name in ("tmp", "work"):
            (disk.place / name).mkdir()
        monkeypatch.setenv("TMPDIR", str(disk.place / "tmp"))
        make = opened.enter_context(clusters(lambda: disk.place / "c"))
        cluster = make(host("h0"), liveness=LIVENESS)
        work = disk.place / "work"
        (work / "wait").touch()
        waits = "while [ -e wait ]; do sleep 0.05; done; echo done; exit 7"
        place = {"working_directory": str(work)}
        cluster.submit(service("runs", **place), job("ends", "sh", "-c", waits, **place))
        runs = cluster.wait("runs", "running")
        cluster.wait("ends", "running")
        disk.fill()
        (work / "wait").unlink()
        cluster.wait_until("the full disk is reported", lambda view: view.trouble != "")
        cluster.slaves["h0"].process.kill()
        cluster.slaves["h0"].process.wait(PATIENCE)
        cluster.start_slave(host("h0"))
        cluster.wait_for_hosts(60.0)
        disk.make_room()

        assert cluster.ended("ends", timeout=60.0).exit_code == 7
        cluster.wait_until("the master accepts work", lambda view: view.trouble == "", 60.0)
        cluster.submit(job("new", "true", **place))
        assert cluster.ended("new", timeout=60.0).exit_code == 0
        assert cluster.process("runs").pid == runs.pid
        assert [part.process.poll() for part in cluster.parts()] == [None, None]
