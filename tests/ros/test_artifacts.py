"""Artifacts with real masters, slaves and processes."""

from __future__ import annotations

import json
import os
import sys

from rosrm.client.client import Client
from rosrm.config.settings import ArtifactCacheSettings
from tests.ros.clusters import STEADY, host

#: A program that prints the other artifact, and its own place.
PROGRAM = """
import os, pathlib
here = pathlib.Path(os.environ["ROSRM_ARTIFACTS"])
print("reads", (here / "data" / "words.txt").read_text(), pathlib.Path(__file__).parent.parent == here)
"""


def write(directory, words: str):
    """Return a work file with a job that has a directory and a file."""
    (directory / "scripts").mkdir(exist_ok=True)
    (directory / "scripts" / "main.py").write_text(PROGRAM)
    (directory / "words.txt").write_text(words)
    work = {
        "name": "reader", "kind": "job", "command": [sys.executable, "{artifacts}/scripts/main.py"],
        "artifacts": {"scripts": "./scripts", "data/words.txt": "words.txt"},
    }  # fmt: skip
    path = directory / "work.yaml"
    path.write_text(json.dumps({"processes": [work]}))
    return path


def test_a_job_runs_with_its_files_from_the_cache_until_they_change(make_cluster, tmp_path):
    """The host fetches each content once, also after a restart of the master."""
    cluster = make_cluster(host("one"), liveness=STEADY)
    Client(connection=cluster.client).submit(write(tmp_path, "first"))
    assert cluster.ended("reader").state == "finished"
    assert "reads first True" in cluster.log("reader")
    assert cluster.log_of("one").count("was fetched") == 2
    cluster.restart_master()
    cluster.wait_for_hosts()
    cluster.client.restart(["reader"])
    cluster.wait("reader", "finished", where=lambda row: row.number > 1)
    assert cluster.log_of("one").count("was fetched") == 2
    Client(connection=cluster.client).submit(write(tmp_path, "second"))
    cluster.wait("reader", "finished", where=lambda row: row.number > 2)
    assert "reads second True" in cluster.log("reader")
    assert cluster.log_of("one").count("was fetched") == 3


def test_a_host_without_room_is_skipped(make_cluster, tmp_path):
    """The process waits for a host with a larger cache, and its reason names the setting."""
    small = host("small", artifacts=ArtifactCacheSettings(max_size=1_000_000))
    cluster = make_cluster(small, liveness=STEADY)
    path = write(tmp_path, "large")
    (tmp_path / "scripts" / "data.bin").write_bytes(os.urandom(3_000_000))
    Client(connection=cluster.client).submit(path)
    reason = cluster.wait("reader", "set_aside", "queued", where=lambda row: "1.0 MB" in row.reason)
    assert "artifacts.max_size" in reason.reason
    cluster.add(host("large"))
    assert cluster.ended("reader").host == "large"
