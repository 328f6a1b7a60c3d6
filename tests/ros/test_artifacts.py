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
own = pathlib.Path(__file__).parent.parent
print("reads", (here / "data" / "words.txt").read_text(), own == here)
"""


def write(directory, words: str):
    """Return a work file with a job that has a directory and a file."""
    (directory / "scripts").mkdir(exist_ok=True)
    (directory / "scripts" / "main.py").write_text(PROGRAM)
    (directory / "words.txt").write_text(words)
    work = {
        "name": "reader", "kind": "job", "command": [sys.executable, "{artifacts}/scripts/main.py"],
        "artifacts": {"scripts": "./scripts", "data/words.txt": "words.txt"},
        "labels": {"preferred": {"first": "yes"}},
    }  # fmt: skip
    path = directory / "work.yaml"
    path.write_text(json.dumps({"processes": [work]}))
    return path


def finish(cluster, act) -> str:
    """Let a job run, and return its log once it has finished."""
    before = cluster.client.list().last_sequence
    act(cluster.client)
    cluster.wait_for_event("finished", process="reader", after=before)
    return cluster.log("reader")


def test_a_job_runs_with_its_files_from_the_cache_until_they_change(make_cluster, tmp_path):
    """The host fetches each content once, also after a restart of the master."""
    cluster = make_cluster(host("one"), liveness=STEADY)
    log = finish(cluster, lambda to: Client(connection=to).submit(write(tmp_path, "first")))
    assert "reads first True" in log
    assert cluster.log_of("one").count("was fetched") == 2
    cluster.restart_master()
    cluster.wait_for_hosts()
    finish(cluster, lambda to: to.restart(["reader"]))
    assert cluster.log_of("one").count("was fetched") == 2
    log = finish(cluster, lambda to: Client(connection=to).submit(write(tmp_path, "second")))
    assert "reads second True" in log
    assert cluster.log_of("one").count("was fetched") == 3


def test_a_host_without_room_is_skipped(make_cluster, tmp_path):
    """The next host runs the process, and the reason of the first one names the setting."""
    cache = ArtifactCacheSettings(max_size=1_000_000)
    small = host("small", artifacts=cache, labels={"first": "yes"})
    cluster = make_cluster(small, host("large"), liveness=STEADY)
    path = write(tmp_path, "large")
    (tmp_path / "scripts" / "data.bin").write_bytes(os.urandom(3_000_000))
    Client(connection=cluster.client).submit(path)
    row = cluster.ended("reader")
    assert (row.state, row.host) == ("finished", "large")
    cluster.wait_for_event("queued", "raise `artifacts.max_size` in its host.yaml", host="small")
