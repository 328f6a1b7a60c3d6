"""SLAM as a whole: accuracy, and completeness of its state."""

from __future__ import annotations

import io
import time

import numpy as np
import pytest

from rosrm_examples.arrays import Arrays, Floats
from rosrm_examples.drives import Drive, load_drive
from rosrm_examples.merge import end_error_percent
from rosrm_examples.poses import quaternion, rotation_from_vector, vector_from_rotation
from rosrm_examples.slam import Slam, SlamSettings


def go_on(slam: Slam, drive: Drive) -> Floats:
    """Feed a drive's scans; return all poses so far, (S, 4, 4)."""
    for points, t in zip(drive.scans(), drive.times, strict=True):
        slam.add_scan(points, t)
    return np.array(slam.poses)


def over_the_wire(state: Arrays) -> Arrays:
    """Write and read a state as npz, without pickle."""
    wire = io.BytesIO()
    np.savez(wire, allow_pickle=False, **state)
    wire.seek(0)
    with np.load(wire, allow_pickle=False) as archive:
        return dict(archive)


def test_kitti_0001_is_mapped_truly(kitti0001: Drive) -> None:
    """The end of drive 0001's first 60 scans is within 1.5 % of the path, at a usable speed."""
    drive = kitti0001.part(0, 60)
    started = time.process_time()
    poses = go_on(Slam(), drive)
    assert drive.truth is not None
    assert end_error_percent(poses, drive.truth) < 1.5
    assert (time.process_time() - started) / len(drive) < 0.3


def test_the_street_is_mapped_truly() -> None:
    """The whole simulated street, bend and all, ends within 2 % of the path."""
    drive = load_drive("street")
    poses = go_on(Slam(), drive)
    assert drive.truth is not None
    assert end_error_percent(poses, drive.truth) < 2.0
    turned = vector_from_rotation(poses[-1, :3, :3] @ drive.truth[-1, :3, :3].T)
    assert np.linalg.norm(turned) < np.radians(1)


def test_mapping_may_start_anywhere_and_fast(street) -> None:
    """Without a known motion, SLAM finds 20 m/s at once, at any start on the street."""
    drive = street(60)
    assert drive.truth is not None
    for start in range(0, 56, 4):
        slam = Slam()
        for index in (start, start + 2, start + 4):
            slam.add_scan(drive.read(index), drive.times[index])
        true = np.linalg.inv(drive.truth[start]) @ drive.truth[start + 4]
        assert np.linalg.norm(slam.poses[-1][:3, 3] - true[:3, 3]) < 0.3


@pytest.mark.parametrize("at", [0, 1, 2, 7])
def test_a_restored_slam_goes_on_to_the_last_bit(street, at: int) -> None:
    """Saved after any scan and restored, it gives the very trajectory and map of the original."""
    drive = street(12)
    settings = SlamSettings(cells=(3.0, 1.5), strides=(3, 2), keyframe_m=2.5, cloud_voxel_m=0.4)
    whole = Slam(settings)
    expected = go_on(whole, drive)
    before = Slam(settings)
    go_on(before, drive.part(0, at))
    after = Slam.from_state(over_the_wire(before.state()))
    assert np.array_equal(go_on(after, drive.part(at, 12)), expected)
    assert np.array_equal(after.map_points(), whole.map_points())
    assert after.times == whole.times


def test_a_saved_state_stays_what_it_was(street) -> None:
    """The original continues without a change of the saved state."""
    drive = street(8)
    slam = Slam()
    go_on(slam, drive.part(0, 4))
    state = slam.state()
    kept = {name: array.copy() for name, array in state.items()}
    go_on(slam, drive.part(4, 8))
    assert state.keys() == kept.keys()
    assert all(np.array_equal(state[name], kept[name]) for name in kept)


def test_the_state_without_the_map_is_small_and_nearly_as_good(street) -> None:
    """Pose and motion alone continue the drive within 0.1 m, with the last scan as a new map."""
    drive = street(20)
    scans = list(drive.scans())
    expected = go_on(Slam(), drive)
    before = Slam()
    go_on(before, drive.part(0, 10))
    state = before.state(with_map=False)
    assert sum(array.nbytes for array in state.values()) < 10_000
    after = Slam.from_state(over_the_wire(state))
    after.add_to_map(scans[9])
    poses = go_on(after, drive.part(10, 20))
    assert np.linalg.norm(poses[:, :3, 3] - expected[:, :3, 3], axis=1).max() < 0.1


def test_a_state_of_another_format_is_refused() -> None:
    """A state that a later version wrote is refused, not misread."""
    with pytest.raises(ValueError, match="format 2"):
        Slam.from_state({**Slam().state(), "format": np.array(2)})


def test_points_that_are_not_finite_are_left_out(street) -> None:
    """A sensor's NaN for 'no echo' changes nothing."""
    drive = street(3)
    clean, dirty = Slam(), Slam()
    for points, t in zip(drive.scans(), drive.times, strict=True):
        clean.add_scan(points, t)
        dirty.add_scan(np.vstack([points, np.full((5, 3), np.nan, np.float32)]), t)
    assert np.array_equal(clean.map_points(), dirty.map_points())


def test_a_scan_from_the_past_is_refused() -> None:
    """Time only goes forward; the error names both times."""
    slam = Slam()
    slam.add_scan(np.zeros((0, 3)), 5.0)
    with pytest.raises(ValueError, match=r"scan at 5\.0 s: it must be later than the last, 5\.0"):
        slam.add_scan(np.zeros((0, 3)), 5.0)


def test_a_scan_without_points_goes_on_as_before(street) -> None:
    """The pose of an empty scan is the predicted one."""
    drive = street(3)
    slam = Slam()
    poses = go_on(slam, drive)
    ahead = slam.add_scan(np.zeros((0, 3)), 2 * drive.times[2] - drive.times[1])
    step = np.linalg.inv(poses[1]) @ poses[2]
    assert ahead == pytest.approx(poses[2] @ step, abs=1e-9)


@pytest.mark.parametrize("vector", [[0, 0, 0], [1e-10, 0, 0], [0.3, -0.2, 1.1], [0, 3.0, 0]])
def test_rotations_go_back_and_forth(vector: list[float]) -> None:
    """A rotation vector, its matrix and its quaternion describe the same rotation."""
    given = np.array(vector)
    rotation = rotation_from_vector(given)
    assert vector_from_rotation(rotation) == pytest.approx(given, abs=1e-12)
    x, y, z, w = quaternion(rotation)
    skew = rotation - rotation.T
    axis = np.array([skew[2, 1], skew[0, 2], skew[1, 0]])
    assert np.array([x, y, z]) * 2 * w == pytest.approx(axis / 2)
    assert x * x + y * y + z * z + w * w == pytest.approx(1)
