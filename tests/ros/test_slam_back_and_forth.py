"""One drive, mapped live by a SLAM that migrates ten times in its course."""

from __future__ import annotations

import json
import sys
from contextlib import closing, suppress
from pathlib import Path

import pytest

from rosrm.config.settings import MigrationSettings
from rosrm.errors import Refused
from rosrm.model.values import Kind, MigrationPolicy, ProcessSpec
from rosrm_examples.drives import Drive, default_drive
from rosrm_examples.map_part import load_parts
from rosrm_examples.migration_results import LiveRun, differences, summarise, unmigrated_poses
from rosrm_examples.observer import Observer
from tests.ros.clusters import host
from tests.waiting import holds_for, wait_until

MOVES = 10
#: Seconds of the complete drive: on a busy machine ten consecutive migrations take so long.
LONG_S = 90.0


@pytest.fixture(scope="module")
def drive() -> Drive:
    return default_drive()


def slam(out: Path) -> ProcessSpec:
    return ProcessSpec(
        "slam", module="rosrm_examples.slam_node", ros=True, parameters={"out": str(out)},
        environment={"OMP_NUM_THREADS": "1"}, migration=MigrationPolicy("handoff"),
    )  # fmt: skip


def player(drive: Drive, hz: float, report: Path) -> ProcessSpec:
    command = (
        sys.executable, "-m", "rosrm_examples.player", "--drive", drive.name, "--hz", f"{hz:.3f}",
        "--report", str(report),
    )  # fmt: skip
    return ProcessSpec("player", command=command, kind=Kind.JOB)


@pytest.mark.slow
@pytest.mark.timeout(400)
def test_ten_moves_in_one_drive_lose_no_scan(make_cluster, drive) -> None:
    """Every scan is mapped once, and the trajectory equals that of a SLAM that stays.

    The test ends the drive soon after the last migration.
    """
    cluster = make_cluster(
        host("left"), host("right"),
        migration=MigrationSettings(strategies={"handoff": {}}, automatic=False),
    )  # fmt: skip
    out, report = cluster.directory / "parts", cluster.directory / "player.json"
    hz = len(drive) / LONG_S
    with closing(Observer(cluster.ros)) as observer:
        cluster.submit(slam(out))
        cluster.wait("slam", "running")
        wait_until(observer.publishers, "a publisher of the SLAM")
        cluster.submit(player(drive, hz, report))
        wait_until(lambda: len(observer.received) >= 2, "the first scans are mapped")
        for moves in range(1, MOVES + 1):
            move(cluster, moves)
            assert cluster.process("player").state == "running", "the drive was over too early"
        enough = min(len(observer.received) + 3, len(drive))
        wait_until(lambda: len(observer.received) >= enough, "scans are mapped after the last move")
        with suppress(Refused):  # it was at its end already
            cluster.client.cancel(["player"])
        cluster.ended("player")
        sent = json.loads(report.read_text())["scans_sent"]
        wait_until(lambda: len(observer.received) >= sent, "all scans are mapped")
        holds_for(1.0, lambda: len(observer.received) == sent, "no further scan")
        received = list(observer.received)
    cluster.cancel("slam")
    driven = drive.part(0, sent)
    run = LiveRun(driven, sent, received, load_parts(out), 1.0 / hz)
    summary = summarise(run, unmigrated_poses(driven), cluster.process("slam").migrations)
    assert differences(summary, "full", migrations=MOVES) == [], summary
    assert (summary["scans_sent"], summary["scans_processed"]) == (sent, sent)


def move(cluster, moves: int) -> None:
    """Migrate the SLAM to the other host; wait until the number of migrations is `moves`."""
    there = {"left": "right", "right": "left"}[cluster.process("slam").host]
    cluster.client.migrate("slam", there)
    cluster.wait("slam", "running", migrations=moves, host=there)
