"""One drive, mapped live by a SLAM that migrates ten times in its course."""

from __future__ import annotations

from pathlib import Path

import pytest

from rosrm.config.settings import MigrationSettings
from rosrm.model.values import MigrationPolicy, ProcessSpec
from rosrm_examples.drives import default_drive
from tests.ros.clusters import host
from tests.ros.live_mapping import live_mapping

MOVES = 10
#: Seconds of the complete drive: on a busy machine ten consecutive migrations take so long.
LONG_S = 90.0


def slam(out: Path) -> ProcessSpec:
    return ProcessSpec(
        "slam", module="rosrm_examples.slam_node", ros=True, parameters={"out": str(out)},
        environment={"OMP_NUM_THREADS": "1"}, migration=MigrationPolicy("handoff"),
    )  # fmt: skip


@pytest.mark.slow
@pytest.mark.timeout(400)
def test_ten_moves_in_one_drive_lose_no_scan(make_cluster) -> None:
    """Every scan is mapped once, and the trajectory equals that of a SLAM that stays.

    The test ends the drive soon after the last migration.
    """
    cluster = make_cluster(
        host("left"), host("right"),
        migration=MigrationSettings(strategies={"handoff": {}}, automatic=False),
    )  # fmt: skip
    with live_mapping(cluster, default_drive(), LONG_S) as mapping:
        cluster.submit(slam(mapping.parts))
        mapping.play()
        for moves in range(1, MOVES + 1):
            move(cluster, moves)
            mapping.check_playing()
        mapping.finish(MOVES)


def move(cluster, moves: int) -> None:
    """Migrate the SLAM to the other host; wait until the number of migrations is `moves`."""
    there = {"left": "right", "right": "left"}[cluster.process("slam").host]
    cluster.client.migrate("slam", there)
    cluster.wait("slam", "running", migrations=moves, host=there)
