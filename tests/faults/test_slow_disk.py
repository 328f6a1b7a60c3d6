"""A disk whose syncs take seconds: a busy SD card, or a disk that other programs write to."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks.crash import slow_sync
from benchmarks.crash.recording import compiled
from benchmarks.hosts import Sync
from rosrm.config.settings import JournalSettings
from rosrm.model.values import IsolationPolicy
from tests.ros.clusters import STEADY, alive, host, job, service

#: Milliseconds of a sync. A request may wait for three of them, and its client waits 10 s.
SYNC = 2000
#: Bytes of a job. The intents of forty exceed the write-ahead log, so a checkpoint begins.
LARGE = 40_000


@pytest.mark.slow
@pytest.mark.parametrize("sync", ["normal", "full"])
def test_a_slow_disk_of_the_master_stops_no_process(
    make_cluster, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, sync: Sync
) -> None:
    """The master sends beats while a write waits for the disk, so no host loses it.

    Requests wait for the disk, too, and jobs are started.
    """
    cluster = make_cluster(host("h0"), journal=JournalSettings(sync=sync), liveness=STEADY)
    library = compiled(Path(slow_sync.__file__).with_name("slow_sync.c"), tmp_path)
    monkeypatch.setenv("SYNC_DELAY_MS", str(SYNC))
    monkeypatch.setenv("LD_PRELOAD", str(library))
    cluster.restart_master()
    cluster.wait_for_hosts()
    cluster.submit(service("singleton", isolation=IsolationPolicy("stop")))
    pid = cluster.wait("singleton", "running").pid
    names = [f"j{n}" for n in range(40 if sync == "normal" else 2)]
    for name in names:
        cluster.submit(job(name, "sh", "-c", "true", "x" * LARGE))
    for name in names:
        assert cluster.ended(name).state == "finished"
    assert not cluster.events("host_suspect")
    assert cluster.wait("singleton", "running").pid == pid
    assert alive(pid)
