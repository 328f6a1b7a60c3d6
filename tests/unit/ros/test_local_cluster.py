"""Local clusters, as used by demos and benchmarks."""

from __future__ import annotations

from pathlib import Path

from rosrm.testing.local_cluster import LocalCluster


def test_its_directory_may_be_relative(tmp_path, monkeypatch) -> None:
    """Processes with other working directories get absolute names of files in the directory."""
    monkeypatch.chdir(tmp_path)
    cluster = LocalCluster(Path("here"))
    cluster.close()
    assert cluster.directory == tmp_path / "here"
