"""A disk of a host whose syncs take seconds: no loop waits for it, and starts share its syncs."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks.crash.recording import compiled
from rosrm.client.client import Client
from rosrm.config.settings import LivenessSettings
from rosrm.model.values import IsolationPolicy, MigrationPolicy, ProcessSpec, Readiness
from tests.ros.clusters import clusters, host, job, service

SLOW_SYNC = Path(__file__).parents[2] / "benchmarks" / "crash" / "slow_sync.c"
#: Seconds of a sync: longer than a host may be silent without becoming suspect.
SYNC = 3.0
LIVENESS = LivenessSettings(suspect=2.0, lease=6.0)


class SlowDisk:
    """The disk with the state of all hosts.

    Args:
        log: with one line for each sync.
    """

    def __init__(self, log: Path) -> None:
        self._log = log

    def syncs(self, *names: str) -> list[tuple[int, int, str]]:
        """Return pid, thread and path of each sync so far; `names`: only of paths with one."""
        lines = [line.split(" ", 2) for line in self._log.read_text().splitlines()]
        return [
            (int(pid), int(thread), path) for pid, thread, path in lines
            if not names or any(name in path for name in names)
        ]  # fmt: skip


@pytest.fixture
def disk(tmp_path, monkeypatch):
    log = tmp_path / "syncs"
    log.touch()
    monkeypatch.setenv("LD_PRELOAD", str(compiled(SLOW_SYNC, tmp_path)))
    monkeypatch.setenv("SYNC_DELAY_MS", f"{SYNC * 1000:g}")
    monkeypatch.setenv("SYNC_BELOW", str(tmp_path / "c" / "hosts"))
    monkeypatch.setenv("SYNC_LOG", str(log))
    return SlowDisk(log)


@pytest.fixture
def cluster(disk, tmp_path):
    with clusters(lambda: tmp_path / "c") as make:
        yield make(host("h0"), liveness=LIVENESS)


def test_no_loop_waits_for_a_slow_sync(cluster, disk, tmp_path) -> None:
    """Jobs with parameters and keys need no sync; artifacts and keys of snapshots delay starts.

    The host reports all the time, so nothing on it is fenced.
    """
    cluster.submit(service("isolated", isolation=IsolationPolicy("stop")))
    pid = cluster.wait("isolated", "running").pid
    before = len(disk.syncs())
    nodes = [job(f"node{n}", "true", ros=True, parameters={"rate": n}) for n in range(8)]
    for row in cluster.run(*(job(f"job{n}", "true") for n in range(8)), *nodes):
        assert row.state == "finished"
    assert disk.syncs()[before:] == []
    stateful = {
        "ros": True, "migration": MigrationPolicy("handoff"), "readiness": Readiness("running"),
        "command": ("sh", "-c", "exec sleep 1000"),
    }  # fmt: skip
    cluster.submit(*(ProcessSpec(f"stateful{n}", **stateful) for n in range(4)))
    (tmp_path / "words").mkdir()
    for name in ("one", "two", "three"):
        (tmp_path / "words" / name).write_text(name)
    words = {"words": str(tmp_path / "words")}
    Client(connection=cluster.client).submit(
        [{"name": "late", "kind": "job", "command": ["true"], "artifacts": words}]
    )
    assert cluster.ended("late").state == "finished"
    for number in range(4):
        assert cluster.wait(f"stateful{number}", "running").restarts == 0
    assert disk.syncs("/artifacts/")
    assert disk.syncs("/kept/")  # keys of snapshots
    assert [one for one in disk.syncs() if one[0] == one[1]] == []
    assert not cluster.events("host_suspect")
    assert cluster.wait("isolated", "running").pid == pid
