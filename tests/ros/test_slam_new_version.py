"""One drive, mapped live by an application whose SLAM is replaced during the drive."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import pytest

from rosrm import Client
from rosrm.config.settings import MigrationSettings
from rosrm.model.applications import ApplicationRow
from rosrm_examples.drives import default_drive
from tests.ros.clusters import Cluster, host
from tests.ros.live_mapping import live_mapping
from tests.waiting import PATIENCE

#: Seconds of the complete drive: on a busy machine two replacements take so long.
LONG_S = 45.0
NEWER = [sys.executable, str(Path(__file__).parent / "programs" / "newer_slam.py")]


@pytest.mark.slow
@pytest.mark.timeout(200)
def test_a_new_version_takes_over_in_mid_drive_and_loses_no_scan(make_cluster) -> None:
    """Every scan is mapped once, also past a version that cannot restore the state.

    The test ends the drive soon after the last replacement.
    """
    cluster = make_cluster(
        host("robot"), migration=MigrationSettings(strategies={"handoff": {}}, automatic=False)
    )
    with live_mapping(cluster, default_drive(), LONG_S) as mapping:
        apply(cluster, slam(mapping.parts, {"module": "rosrm_examples.slam_node"}, map_every=10))
        mapping.play()
        row = apply(cluster, slam(mapping.parts, {"command": NEWER}, map_every=5))
        assert (row.state, row.version) == ("running", 2), row
        forgetful = slam(mapping.parts, {"command": [*NEWER, "--forgetful"]}, map_every=5)
        row = apply(cluster, forgetful)
        assert (row.state, row.version) == ("running", 2), row
        assert "velocity_of_sensor" in row.versions[-1].given_up, row
        mapping.check_playing()
        mapping.finish(handoffs=1)


def slam(out: Path, program: dict[str, Any], map_every: int) -> dict[str, Any]:
    """Return a process as in a work file."""
    return {
        "name": "slam", "ros": True, **program, "migration": "handoff",
        "parameters": {"out": str(out), "map_every": map_every},
        "environment": {"OMP_NUM_THREADS": "1"},
    }  # fmt: skip


def apply(cluster: Cluster, process: dict[str, Any]) -> ApplicationRow:
    """Apply a changed file, and wait until the application is not changed further."""
    file = cluster.directory / "mapping.yaml"
    content = {"app": "mapping", "rollout": {"healthy_for": "1s"}, "processes": [process]}
    file.write_text(json.dumps(content))  # JSON is YAML
    client = Client(connection=cluster.client)
    client.apply(file)
    [row] = client.wait_for_applications("mapping", timeout=PATIENCE)
    return row
