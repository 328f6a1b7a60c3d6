"""Local clusters, as used by demos and benchmarks."""

from __future__ import annotations

import json
from pathlib import Path

from rosrm.testing.local_cluster import LocalCluster
from tests.ros.clusters import PATIENCE, host, node, wait_until


def test_its_directory_may_be_relative(tmp_path, monkeypatch) -> None:
    """A node finds its parameter file, although its working directory is another one."""
    monkeypatch.chdir(tmp_path)
    with LocalCluster(Path("here"), hosts=[host("h0")]) as cluster:
        cluster.client.submit([node("reader", parameters={"answer": 42})])
        cluster.wait_until(
            "the node running", lambda view: view.processes[0].state == "running", PATIENCE
        )
        (log,) = (tmp_path / "here").glob("hosts/h0/supervisor/logs/reader.*.log")
        wait_until(lambda: "\n" in log.read_text(), "the node's first line")
        assert json.loads(log.read_text().splitlines()[0])["parameters"] == {"answer": 42}
