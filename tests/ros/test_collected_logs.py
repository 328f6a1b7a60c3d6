"""`rosrm collect-logs` on a real cluster: a collector that is killed, and a host that is lost."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from rosrm.archive.reader import LogArchive
from rosrm.config.settings import LivenessSettings
from rosrm.errors import Refused
from tests.ros.clusters import Cluster, host, python
from tests.waiting import PATIENCE, wait_until

#: Prints 1.1 MB at once, and an error at the end.
PROGRAM = """
import time
for number in range(100_000): print("line", number)
print("[ERROR] [%.6f] [nav]: motor stalled" % time.time(), flush=True)
time.sleep(1000)
"""


def environment(cluster: Cluster) -> dict[str, str]:
    return {**os.environ, "ROS_DOMAIN_ID": str(cluster.domain), "NO_COLOR": "1"}


@contextlib.contextmanager
def collector(cluster: Cluster, archive: Path, *options: str):
    """Run a collector, and kill it."""
    argv = [sys.executable, "-m", "rosrm.cli", "collect-logs", str(archive), *options]
    log = (cluster.directory / "collector.log").open("ab")
    with log, subprocess.Popen(argv, env=environment(cluster), stdout=log, stderr=log) as process:
        try:
            yield process
        finally:
            process.kill()


def logs(cluster: Cluster, archive: Path, *words: str) -> subprocess.CompletedProcess:
    argv = [sys.executable, "-m", "rosrm.cli", "logs", "--archive", str(archive), *words]
    return subprocess.run(
        argv, check=False, env=environment(cluster), capture_output=True, text=True,
        timeout=PATIENCE,
    )  # fmt: skip


def collected(archive: Path, on: str, process: str) -> bytes:
    """Return what the archive has of a process."""
    content = b""
    with contextlib.suppress(Refused):
        reader = LogArchive(archive)
        for number in reader.numbers(on, process):
            while part := reader.read_log(on, process, number, len(content)).content:
                content += part
    return content


@pytest.fixture
def cluster(make_cluster) -> Cluster:
    return make_cluster(host("a"), liveness=LivenessSettings(suspect=2.0, lease=4.0))


def test_the_lines_of_a_lost_host_are_found_after_kills_of_the_collector(cluster) -> None:
    """Each line is stored once, and the command finds it when the host is gone."""
    archive = cluster.directory / "archive"
    expected = b"".join(b"line %d\n" % number for number in range(100_000))
    with collector(cluster, archive, "--max-rate", "100kB"):
        cluster.submit(python("first", PROGRAM))
        cluster.wait("first", "running")
        wait_until(lambda: collected(archive, "a", "first"), "the first bytes")
    assert len(collected(archive, "a", "first")) < len(expected)
    with collector(cluster, archive, "--every", "0.2s"):
        cluster.submit(python("second", PROGRAM))
        wait_until(lambda: b"stalled" in collected(archive, "a", "first"), "all of the first")
        wait_until(lambda: b"stalled" in collected(archive, "a", "second"), "all of the second")
    for name in ("first", "second"):
        content = collected(archive, "a", name)
        assert content.startswith(expected)
        assert content.count(b"\n") == 100_001

    cluster.end(cluster.slaves["a"], signal.SIGKILL)
    wait_until(lambda: cluster.client.list(hosts=True).hosts[0].state == "lost", "a lost host")
    found = logs(cluster, archive, "first", "second", "--grep", "stalled", "--since", "1h")
    assert found.returncode == 0, found.stderr
    assert [line.split("|")[0].strip() for line in found.stdout.splitlines()] == ["first", "second"]
    assert "Its output there is read from" in found.stderr
    cluster.start_slave_again("a")
    cluster.cancel("first", "second")


def test_a_second_collector_on_one_directory_is_refused(cluster) -> None:
    archive = cluster.directory / "archive"
    with collector(cluster, archive) as first:
        lock = archive / "collector.lock"
        mark = [str(first.pid)]
        wait_until(lambda: lock.exists() and lock.read_text().split() == mark, "the lock")
        with collector(cluster, archive) as second:
            assert second.wait(PATIENCE) == 1
        first.send_signal(signal.SIGTERM)
        assert first.wait(PATIENCE) == 0
    assert "a collector runs already on" in (cluster.directory / "collector.log").read_text()
