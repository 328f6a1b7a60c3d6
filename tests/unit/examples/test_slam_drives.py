"""Sources of drives, and errors of unreadable ones."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rosrm_examples import drives
from rosrm_examples.drives import default_drive, load_drive
from rosrm_examples.errors import DriveError

EARTH_RADIUS_M = 6378137.0


def write_npz(path: Path, **changes: object) -> Path:
    """Write a thinned drive of two scans with 2 and 1 points; `changes` spoil it."""
    arrays = {
        "xyz_cm": np.array([[100, 200, -300], [0, 0, 50], [7, 8, 9]], np.int16),
        "count": np.array([2, 1], np.int32),
        "t": np.array([10.0, 10.1]),
        "T_world_velo": np.stack([np.eye(4), np.eye(4)]),
        **changes,
    }
    kept: dict[str, Any] = {name: array for name, array in arrays.items() if array is not None}
    np.savez(path, allow_pickle=True, **kept)
    return path


def write_raw(root: Path, numbers: tuple[int, ...] = (0, 1, 2)) -> Path:
    """Write a raw drive that goes 10 m north in each step, facing north."""
    folder = root / "2011_09_26" / "2011_09_26_drive_0042_sync"
    scans, packets = folder / "velodyne_points" / "data", folder / "oxts" / "data"
    scans.mkdir(parents=True)
    packets.mkdir(parents=True)
    stamps = [f"2011-09-26 13:02:25.{n}51199337" for n in range(max(numbers) + 1)]
    (folder / "velodyne_points" / "timestamps.txt").write_text("\n".join(stamps) + "\n")
    for number in numbers:
        points = [[1, 0, 0, 0.5], [10.1, 0.1, 0.1, 0.5], [10.3, 0.1, 0.1, 0], [80, 0, 0, 0]]
        np.array(points, "<f4").tofile(scans / f"{number:010d}.bin")
        latitude = 49.0 + np.degrees(10.0 * number / EARTH_RADIUS_M)
        (packets / f"{number:010d}.txt").write_text(f"{latitude:.15f} 8.4 112 0 0 {np.pi / 2} 0 0")
    return folder


def test_a_thinned_drive_gives_its_scans_in_metres(tmp_path: Path) -> None:
    """A thinned archive comes back scan by scan, with times and true poses."""
    drive = load_drive(write_npz(tmp_path / "two.npz"))
    first, second = drive.scans()
    assert first == pytest.approx(np.array([[1, 2, -3], [0, 0, 0.5]], np.float32))
    assert second == pytest.approx(np.array([[0.07, 0.08, 0.09]], np.float32))
    assert first.dtype == np.float32
    assert drive.times.tolist() == [10.0, 10.1]
    assert drive.truth is not None
    assert drive.truth.shape == (2, 4, 4)


def test_a_raw_folder_is_read_and_thinned(tmp_path: Path) -> None:
    """KITTI's raw layout gives thinned scans, times in unix seconds, and true poses."""
    drive = load_drive(write_raw(tmp_path))
    scan = next(drive.scans())
    assert scan == pytest.approx(np.array([[10.2, 0.1, 0.1]]), abs=1e-5)
    assert drive.times[0] == pytest.approx(1317042145.051199, abs=1e-6)
    assert drive.truth is not None
    assert drive.truth[:, :3, 3] == pytest.approx(
        np.array([[0, 0, 0], [10, 0, 0], [20, 0, 0]]), abs=1e-3
    )


def test_a_raw_drive_may_lack_scans(tmp_path: Path) -> None:
    """A scan's number, not its place in the folder, says which time and pose are its own."""
    drive = load_drive(write_raw(tmp_path, numbers=(0, 2)))
    assert drive.indices.tolist() == [0, 2]
    assert drive.times[1] - drive.times[0] == pytest.approx(0.2)
    assert drive.truth is not None
    assert drive.truth[1, 0, 3] == pytest.approx(20, abs=1e-3)


def test_a_raw_drive_without_positioning_has_no_truth(tmp_path: Path) -> None:
    """Scans and times suffice for a drive."""
    folder = write_raw(tmp_path)
    (folder / "oxts" / "data" / "0000000001.txt").unlink()
    assert load_drive(folder).truth is None


def test_the_calibration_beside_a_drive_is_used(tmp_path: Path) -> None:
    """A scanner that is mounted askew sees the same motion in its own axes."""
    folder = write_raw(tmp_path)
    (folder.parent / "calib_imu_to_velo.txt").write_text(
        "calib_time: 25-May-2012 16:47:16\nR: 0 1 0 -1 0 0 0 0 1\nT: 0 0 0\n"
    )
    truth = load_drive(folder).truth
    assert truth is not None
    assert truth[1, :3, 3] == pytest.approx([0, -10, 0], abs=1e-3)


def test_a_number_finds_a_download(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A drive named by its number, kittiNNNN, is found in the folder that the environment names."""
    write_raw(tmp_path)
    monkeypatch.setenv("ROSRM_KITTI", str(tmp_path))
    assert len(load_drive("kitti0042")) == 3


def test_without_kitti_the_default_is_the_street(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A machine without any download still has a drive."""
    monkeypatch.setenv("ROSRM_KITTI", str(tmp_path))
    assert default_drive().name == "street"


@pytest.mark.parametrize(
    ("name", "says"),
    [
        ("kitti9999", "ROSRM_KITTI"),
        ("nowhere.npz", "'street:SCANS'"),
        ("street:many", "whole number"),
        ("street:1", "from 2"),
    ],
)
def test_an_unknown_drive_is_refused(name: str, says: str) -> None:
    """The error names what was given and what is allowed."""
    with pytest.raises(DriveError) as refused:
        load_drive(name)
    assert name in str(refused.value)
    assert says in str(refused.value)


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"t": None}, "needed are xyz_cm, count, t, T_world_velo"),
        ({"t": np.zeros(3)}, "'t' has shape (3,)"),
        ({"xyz_cm": np.zeros((3, 2), np.int16)}, "'xyz_cm' has shape (3, 2)"),
        ({"count": np.array([2, 2], np.int32)}, "must add up to the 3 points"),
        ({"t": np.array([{}, {}])}, "cannot be read as .npz"),
        ({"t": np.array([10.0, 10.0])}, "scan 1 is not later"),
    ],
)
def test_a_damaged_archive_is_refused(
    tmp_path: Path, changes: dict[str, object], says: str
) -> None:
    """The error names the file and the array; nothing is ever unpickled."""
    path = write_npz(tmp_path / "bad.npz", **changes)
    with pytest.raises(DriveError) as refused:
        load_drive(path)
    assert str(path) in str(refused.value)
    assert says in str(refused.value)


def test_a_file_that_is_no_archive_is_refused(tmp_path: Path) -> None:
    """Garbage, an empty folder and a file of another kind each get one clear error."""
    (tmp_path / "garbage.npz").write_bytes(b"garbage")
    (tmp_path / "notes.txt").write_text("notes")
    (tmp_path / "empty").mkdir()
    for name, says in (
        ("garbage.npz", "cannot be read"),
        ("notes.txt", "is no drive"),
        ("empty", "no scans in velodyne_points/data"),
    ):
        with pytest.raises(DriveError, match=says):
            load_drive(tmp_path / name)


def test_damaged_raw_files_are_refused(tmp_path: Path) -> None:
    """A cut scan and a packet without numbers are named by their path."""
    folder = write_raw(tmp_path)
    (folder / "velodyne_points" / "data" / "0000000001.bin").write_bytes(b"\0" * 20)
    with pytest.raises(DriveError, match=r"0000000001\.bin: not a whole number of points"):
        list(load_drive(folder).scans())
    (folder / "oxts" / "data" / "0000000002.txt").write_text("north")
    with pytest.raises(DriveError, match=r"0000000002\.txt"):
        load_drive(folder)
    (folder / "velodyne_points" / "timestamps.txt").write_text("2011-09-26 13:02:25.95\n")
    with pytest.raises(DriveError, match="1 times, needed is one for scan 2"):
        load_drive(folder)


@given(st.data())
def test_pieces_cover_the_drive_and_neighbours_overlap(data: st.DataObject) -> None:
    """Every scan is in a piece, and each piece shares its last scans with the next one."""
    of = data.draw(st.integers(1, 12), "of")
    scans = data.draw(st.integers(2 * of, 200), "scans")
    overlap = data.draw(st.integers(1, 6), "overlap")
    times = np.arange(scans, dtype=np.float64)
    drive = drives.Drive("d", np.arange(scans), times, None, lambda _: NotImplemented)
    pieces = [drive.piece(k, of, overlap) for k in range(1, of + 1)]
    assert set(np.concatenate([piece.indices for piece in pieces])) == set(range(scans))
    for piece, following in pairwise(pieces):
        shared = np.intersect1d(piece.indices, following.indices)
        assert len(shared) == min(overlap, scans - following.indices[0])
        assert shared[0] == following.indices[0]


def test_a_cut_that_cannot_be_is_refused() -> None:
    """Wrong piece numbers, overlaps and too many pieces say what is allowed."""
    drive = load_drive("street:5")
    for cut, says in (
        ((0, 2), "from 1 to 2"),
        ((3, 2), "from 1 to 2"),
        ((1, 3), "at most 2"),
        ((1, 2, 0), "at least 1"),
    ):
        with pytest.raises(DriveError, match=says):
            drive.piece(*cut)


def test_the_street_is_always_the_same() -> None:
    """A scan depends on the street and its number alone, not on the scans before it."""
    again = load_drive("street:20")
    third = list(again.scans())[3]
    assert np.array_equal(load_drive("street:20").read(3), third)
    assert not np.array_equal(again.read(4), third)
    distance = np.linalg.norm(third, axis=1)
    assert len(third) > 2000
    assert distance.min() > 2
    assert distance.max() < 61
