"""Results of the migration demo, and detection of errors in a run."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("rclpy")

from rosrm_examples.drives import Drive
from rosrm_examples.map_part import MapPart
from rosrm_examples.migration_job import LiveDrive, host_configs, recorder_spec, slam_spec
from rosrm_examples.migration_results import LiveRun, differences, summarise
from rosrm_examples.observer import ReceivedPose
from rosrm_examples.poses import make_pose

SCANS, PERIOD = 6, 0.2
TIMES = 0.1 * np.arange(SCANS)
POSES = np.array([make_pose(np.eye(3), np.array([at, 0.0, 0.0])) for at in range(SCANS)])
DRIVE = Drive("made", np.arange(SCANS), TIMES, POSES, lambda _: np.zeros((0, 3), np.float32))


def part(host: str, first: int, end: int, refused: int = 0) -> MapPart:
    points = np.zeros((5, 3), np.float32)
    return MapPart(host, TIMES[first:end], POSES[first:end], points, refused)


def run() -> LiveRun:
    """Return a run without errors: three scans here, three there, the fourth 30 ms late."""
    late = [0.0, 0.0, 0.0, 0.03, 0.0, 0.0]
    received = [
        ReceivedPose(100.0 + PERIOD * index + late[index], index * 100_000_000, pose)
        for index, pose in enumerate(POSES)
    ]
    return LiveRun(DRIVE, SCANS, received, [part("a", 0, 3), part("b", 3, 6)], PERIOD)


def wrong(seen: LiveRun, state: str = "full", migrations: int = 1) -> list[str]:
    return differences(summarise(seen, POSES, migrations), state, migrations=1)


def test_all_is_well() -> None:
    summary = summarise(run(), POSES, 1)
    assert {key: summary[key] for key in ("scans_sent", "scans_processed")} == {
        "scans_sent": 6, "scans_processed": 6,
    }  # fmt: skip
    assert (summary["scans_lost"], summary["scans_repeated"], summary["migrations"]) == (0, 0, 1)
    assert summary["gap_ms"] == pytest.approx(30.0, abs=0.01)
    assert summary["max_deviation_m"] == 0.0
    assert summary["end_error_percent"] == 0.0
    assert [one["host"] for one in summary["parts"]] == ["a", "b"]
    assert wrong(run()) == []


def test_a_scan_that_was_lost() -> None:
    seen = run()
    seen = replace(seen, received=[*seen.received[:3], *seen.received[4:]])
    assert summarise(seen, POSES, 1)["end_error_percent"] is None
    assert summarise(seen, POSES, 1)["gap_ms"] is None
    assert wrong(seen) == [
        "scans_lost is 1, not 0", "no successor has an output right after its source",
    ]  # fmt: skip


def test_a_scan_that_was_mapped_twice() -> None:
    seen = run()
    again = replace(seen, received=[*seen.received[:3], seen.received[2], *seen.received[3:]])
    assert wrong(again) == ["scans_repeated is 1, not 0"]
    refused = replace(seen, parts=[part("a", 0, 3), part("b", 3, 6, refused=2)])
    assert wrong(refused) == ["scans_repeated is 2, not 0"]


def test_poses_out_of_order() -> None:
    seen = run()
    received = [*seen.received[:4], seen.received[5], seen.received[4]]
    late = replace(seen, received=received)
    assert summarise(late, POSES, 1)["out_of_order"] == 1
    assert wrong(late) == []  # with two writers, repeated DDS messages arrive late


def test_no_migration() -> None:
    seen = replace(run(), parts=[part("a", 0, 6)])
    assert summarise(seen, POSES, 0)["gap_ms"] is None
    assert wrong(seen, migrations=0)[0] == "migrations is 0, not 1"
    # The migration was too late.
    assert wrong(seen) == ["no successor has an output right after its source"]


def test_a_part_that_was_not_written() -> None:
    said = wrong(replace(run(), parts=[part("b", 3, 6)]))
    assert said[0] == "the instances mapped 3 scans of 6"


def test_a_deviation_is_judged_by_what_moved() -> None:
    seen = run()
    moved = make_pose(np.eye(3), np.array([5.0, 0.05, 0.0]))
    seen = replace(seen, received=[*seen.received[:5], replace(seen.received[5], pose=moved)])
    assert wrong(seen, "pose") == []
    assert wrong(seen, "full") == ["max_deviation_m is 0.05, more than 1e-09"]


def test_nothing_was_heard() -> None:
    seen = replace(run(), received=[])
    assert "scans_lost is 6, not 0" in wrong(seen)
    assert "max_deviation_m is None, more than 1e-09" in wrong(seen)


def test_only_the_slam_moves_and_only_off_the_fast_disk(tmp_path) -> None:
    """Only the SLAM may move, and it fits on either big host."""
    live = LiveDrive(DRIVE, 1.0, tmp_path, tmp_path / "report", tmp_path, "full")
    slam, recorder = slam_spec(live), recorder_spec()
    assert slam.migration.strategy == "handoff"
    assert recorder.migration.strategy is None
    hosts = {config.host: config for config in host_configs(2)}
    room = {name: 0.8 * config.budget["memory"] for name, config in hosts.items()}
    assert hosts["host1"].labels == recorder.required_labels == slam.preferred_labels
    assert slam.needs["memory"] < room["host2"]
    player = 80e6  # bytes that it takes
    assert slam.needs["memory"] + player > room["robot"]
