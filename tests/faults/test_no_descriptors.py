"""A slave that can open no further file."""

from __future__ import annotations

import resource

import pytest

from tests.ros.clusters import clusters, host, job, service
from tests.waiting import holds_for


@pytest.fixture
def cluster(tmp_path):
    with clusters(lambda: tmp_path / "c") as make:
        yield make(host("h0"))


def test_a_slave_survives_a_time_without_descriptors(cluster) -> None:
    """Its processes run on, a job waits or fails with the reason, and later jobs run."""
    cluster.submit(service("runs"))
    pid = cluster.wait("runs", "running").pid
    slave = cluster.slaves["h0"].process
    _, hard = before = resource.prlimit(slave.pid, resource.RLIMIT_NOFILE)
    resource.prlimit(slave.pid, resource.RLIMIT_NOFILE, (3, hard))
    cluster.submit(job("without", "true"))
    holds_for(4.0, lambda: slave.poll() is None, "the slave")
    resource.prlimit(slave.pid, resource.RLIMIT_NOFILE, before)
    cluster.submit(job("later", "true"))
    assert cluster.ended("later").state == "finished"
    row = cluster.ended("without")
    assert row.state == "finished" or "Too many open files" in row.reason
    assert cluster.process("runs").pid == pid
    assert slave.poll() is None
