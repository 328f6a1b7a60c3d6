"""A state directory or log folder that does not answer, below a slave and its supervisor."""

from __future__ import annotations

import os
import signal

import pytest

from rosrm.config.settings import LivenessSettings
from rosrm.errors import Refused
from rosrm.model.values import RestartPolicy
from tests.hung_files import hung_files
from tests.ros.clusters import alive, clusters, host, job, service
from tests.waiting import PATIENCE

LIVENESS = LivenessSettings(suspect=3.0, lease=15.0)


@pytest.fixture(params=["state directory", "log directory"])
def part(request):
    return request.param


@pytest.fixture
def hung(part, tmp_path):
    """Mount a file system at the state directory of h0, or below its logs."""
    state = tmp_path / "c" / "hosts" / "h0"
    if part == "state directory":
        with hung_files(state) as hung:
            yield hung
        return
    with hung_files(tmp_path / "logs") as hung:
        (state / "supervisor").mkdir(mode=0o700, parents=True)
        (state / "supervisor" / "logs").symlink_to(hung.place)
        yield hung


@pytest.fixture
def cluster(hung, tmp_path):
    with clusters(lambda: tmp_path / "c") as make:
        yield make(host("h0"), liveness=LIVENESS)
        hung.answer()


def test_the_host_serves_on_and_says_what_is_wrong(cluster, hung, part) -> None:
    """Ends and stops are reported for longer than the lease; a start fails with the reason.

    When the directory answers, processes start and logs can be read.
    """
    pids = {}
    for name in ("ends", "stops", "runs"):
        cluster.submit(service(name, restart=RestartPolicy("never")))
        pids[name] = cluster.wait(name, "running").pid
    hung.hang()
    cluster.wait_for_event("plugin_failed", f"nothing can be written to the {part}")
    os.kill(pids["ends"], signal.SIGKILL)
    assert "SIGKILL" in cluster.ended("ends").reason
    cluster.submit(job("new", "true"))
    assert "does not answer" in cluster.ended("new").reason
    cluster.cancel("stops")
    with pytest.raises(Refused, match="does not answer"):
        cluster.client.read_log("h0", "stops")
    assert cluster.process("runs").pid == pids["runs"]
    assert not cluster.events("host_lost")
    hung.answer()
    cluster.wait_for_event("plugin_works", part)
    cluster.submit(job("later", "true"))
    assert cluster.ended("later").state == "finished"
    assert cluster.client.read_log("h0", "runs").content == b""


def test_a_host_ends_while_its_directory_hangs(cluster, hung, part) -> None:
    """SIGINT stops the processes, and ends the slave and its supervisor."""
    cluster.submit(service("runs"))
    pid = cluster.wait("runs", "running").pid
    hung.hang()
    cluster.wait_for_event("plugin_failed", f"nothing can be written to the {part}")
    slave = cluster.slaves["h0"]
    slave.end(signal.SIGINT)
    assert slave.wait(PATIENCE)
    assert not alive(pid)
    hung.answer()
