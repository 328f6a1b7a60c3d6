"""Kills of the master in the middle of an apply, after each of the events that an apply causes.

`ROSRM_KILLS` is the number of kills (default 6), spread over the events.
"""

from __future__ import annotations

import os
import signal
import sqlite3
from pathlib import Path

import pytest
import yaml

from rosrm.client.waiting import wait_for_applications
from rosrm.config.settings import LivenessSettings, MigrationSettings
from rosrm.config.work import load_application
from rosrm.model.applications import ApplicationRow
from rosrm.supervisor.procfs import read_environment
from tests.faults.test_master_killed import HOLDER
from tests.ros.clusters import Cluster, host, python
from tests.waiting import PATIENCE, wait_until

KILLS = int(os.environ.get("ROSRM_KILLS", "6"))
#: Events of one apply of the versions below: requests, stops, ends, assignments, starts.
EVENTS = 18
STOP = {"interrupt_grace": 0.3, "terminate_grace": 0.3}


def work(directory: Path, number: int) -> Path:
    """Write the file of a version: each changes two processes, and adds or removes another two."""
    command = python("x", HOLDER).command

    def entry(name: str, version: int, **fields: object) -> dict[str, object]:
        arguments = [str(directory), name]
        return {
            "name": name, "command": list(command), "arguments": arguments, "stop": STOP,
            "environment": {"VERSION": str(version)}, **fields,
        }  # fmt: skip

    parts = [
        entry("base", number),
        entry("mover", number, migration={"strategy": "relaunch", "overlap": False}),
        entry("same", 0),
        entry(f"extra{number % 2}", 0, after={"base": "ready"}),
    ]
    content = {"app": "nav", "rollout": {"healthy_for": 0.2, "max_parallel": 2}, "processes": parts}
    path = directory / "nav.yaml"
    path.write_text(yaml.safe_dump(content), encoding="utf-8")
    return path


def events_in(directory: Path) -> int:
    """Return the number of the newest event in the journal, read from its file."""
    path = directory / "master" / "journal.sqlite"
    with sqlite3.connect(f"file:{path}?mode=ro", uri=True, timeout=PATIENCE) as journal:
        (newest,) = journal.execute("SELECT max(sequence) FROM record").fetchone()
    journal.close()
    return int(newest or 0)


def reach(cluster: Cluster) -> ApplicationRow:
    """Wait until the application is as desired; return its row."""
    (row,) = wait_for_applications(
        cluster.client, ["nav"], timeout=PATIENCE, on_change=lambda _: None, notify=lambda _: None
    )
    return row


def version_of(pid: int) -> str:
    (found,) = [one for one in read_environment(pid) if one.startswith(b"VERSION=")]
    return found.decode().partition("=")[2]


@pytest.mark.timeout(60 + 30 * KILLS)
def test_an_apply_continues_after_each_of_its_events(make_cluster) -> None:
    """The version is reached, no process runs twice, none is lost, and the rest is not touched."""
    cluster = make_cluster(
        host("h0", max_processes=6), host("h1", max_processes=6),
        migration=MigrationSettings(automatic=False),
        liveness=LivenessSettings(suspect=5.0, lease=60.0),
    )  # fmt: skip
    cluster.client.apply([load_application(work(cluster.directory, 1))])
    assert reach(cluster).state == "running"
    same = cluster.wait("same", "running").pid
    for kill in range(KILLS):
        number = 2 + kill
        before = events_in(cluster.directory)
        cluster.client.apply([load_application(work(cluster.directory, number))])
        awaited = before + 1 + kill * EVENTS // KILLS
        wait_until(
            lambda awaited=awaited: events_in(cluster.directory) >= awaited,
            f"event {awaited} of the journal", pause=lambda _: None,
        )  # fmt: skip
        cluster.restart_master(signal.SIGKILL)
        cluster.wait_for_hosts()
        row = reach(cluster)
        assert (row.state, row.version, dict(row.pending)) == ("running", number, {}), row
        extra, gone = f"extra{number % 2}", f"extra{1 - number % 2}"
        for name in ("base", "mover"):
            assert version_of(cluster.wait(name, "running").pid) == str(number)
        assert cluster.wait("same", "running").pid == same
        assert cluster.wait(extra, "running")
        assert cluster.wait(gone, "cancelled")
        for name in ("base", "mover", "same", extra):
            said = (cluster.directory / name).read_text(encoding="utf-8").split()
            assert set(said) == {"alone"}, f"{name} ran twice: {said}"
