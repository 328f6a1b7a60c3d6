"""Merge of mapped pieces, and its output files."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from rosrm_examples.drives import Drive, load_drive
from rosrm_examples.errors import PieceError
from rosrm_examples.merge import end_error_percent, join, main
from rosrm_examples.pieces import MapPiece, load_piece, load_pieces, save_piece
from rosrm_examples.ply import write_ply
from rosrm_examples.poses import inverse
from rosrm_examples.slam import Slam


def pieces_of(drive: Drive, of: int, mapped: Callable[[Drive], tuple]) -> list[MapPiece]:
    """Return the pieces of a drive, with the poses and points that a function maps."""
    parts = {number: drive.piece(number, of) for number in range(1, of + 1)}
    return [
        MapPiece(number, of, part.indices, part.times, *mapped(part))
        for number, part in parts.items()
    ]


def perfectly(part: Drive) -> tuple:
    """Map as a SLAM without any error would."""
    assert part.truth is not None
    poses = inverse(part.truth[0]) @ part.truth
    return poses, poses[:, :3, 3].astype(np.float32)


def really(part: Drive) -> tuple:
    """Map as SLAM does."""
    slam = Slam()
    for points, t in zip(part.scans(), part.times, strict=True):
        slam.add_scan(points, t)
    return np.array(slam.poses), slam.map_points()


def perfect_pieces(drive: Drive, of: int) -> list[MapPiece]:
    return pieces_of(drive, of, perfectly)


def test_perfect_pieces_join_to_the_true_drive() -> None:
    """Joining adds no error of its own, and every scan is there once and in order."""
    drive = load_drive("street:40")
    joined = join(perfect_pieces(drive, 5))
    assert drive.truth is not None
    assert joined.indices.tolist() == list(range(40))
    assert np.array_equal(joined.times, drive.times)
    assert joined.poses == pytest.approx(drive.truth, abs=1e-9)


def test_kitti_0001_in_pieces_is_joined_truly(kitti0001: Drive) -> None:
    """The first half of drive 0001, mapped in 3 pieces, ends within 1.5 % of the path."""
    drive = kitti0001.part(0, 54)
    joined = join(pieces_of(drive, 3, really))
    assert drive.truth is not None
    assert end_error_percent(joined.poses, drive.truth) < 1.5


def test_pieces_that_share_no_scan_are_refused() -> None:
    """A gap between two pieces is named by its scans."""
    first, second, third = perfect_pieces(load_drive("street:30"), 3)
    with pytest.raises(PieceError, match=r"piece 3 of 3 starts at scan 20, .* ends at scan 13"):
        join([first, third])
    assert second.number == 2


def test_a_piece_is_read_back_as_it_was_written(tmp_path: Path) -> None:
    """Saving leaves one whole file and nothing else."""
    piece = perfect_pieces(load_drive("street:10"), 2)[1]
    path = save_piece(tmp_path, piece)
    back = load_piece(path)
    assert [file.name for file in path.parent.iterdir()] == ["piece_02.npz"]
    assert (back.number, back.of) == (2, 2)
    for ours, theirs in ((piece.poses, back.poses), (piece.points, back.points)):
        assert np.array_equal(ours, theirs)


def test_missing_and_damaged_pieces_are_refused(tmp_path: Path) -> None:
    """The error names the folder and which pieces are there, or the damaged file."""
    with pytest.raises(PieceError, match="no pieces"):
        load_pieces(tmp_path)
    save_piece(tmp_path, perfect_pieces(load_drive("street:10"), 2)[1])
    with pytest.raises(PieceError, match=r"1 to 2 are needed, found are \[2\]"):
        load_pieces(tmp_path)
    (tmp_path / "piece_01.npz").write_bytes(b"PK cut short")
    with pytest.raises(PieceError, match=r"piece_01\.npz: not a piece"):
        load_pieces(tmp_path)


def test_a_ply_holds_what_was_written(tmp_path: Path) -> None:
    """Header and vertices follow the format: little endian floats, colours as bytes."""
    points = np.random.default_rng(1).normal(size=(50, 3)).astype(np.float32)
    colours = np.arange(150, dtype=np.uint8).reshape(50, 3)
    path = tmp_path / "cloud.ply"
    write_ply(path, points, colours)
    header, _, body = path.read_bytes().partition(b"end_header\n")
    assert header.decode().splitlines() == [
        "ply", "format binary_little_endian 1.0", "element vertex 50",
        *(f"property float {axis}" for axis in "xyz"),
        *(f"property uchar {colour}" for colour in ("red", "green", "blue")),
    ]  # fmt: skip
    vertices = np.frombuffer(body, dtype=[("xyz", "<f4", 3), ("rgb", "u1", 3)])
    assert np.array_equal(vertices["xyz"], points)
    assert np.array_equal(vertices["rgb"], colours)


def test_merge_leaves_map_picture_and_figures(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The command writes its files and prints the figures as its last line."""
    for piece in perfect_pieces(load_drive("street:20"), 2):
        save_piece(tmp_path, piece)
    arguments = ["--drive", "street:20", "--pieces", str(tmp_path), "--out", str(tmp_path / "out")]
    assert main(arguments) == 0
    figures = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert figures == {"scans": 20, "map_points": 20, "end_error_percent": 0.0}
    assert (tmp_path / "out" / "map.ply").stat().st_size > 20 * 12
    assert (tmp_path / "out" / "map.png").read_bytes().startswith(b"\x89PNG")
    with np.load(tmp_path / "out" / "trajectory.npz") as trajectory:
        assert trajectory["poses"].shape == (20, 4, 4)


def test_merge_says_what_it_cannot_use(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Another drive's pieces end in one line and exit status 2."""
    for piece in perfect_pieces(load_drive("street:20"), 2):
        save_piece(tmp_path, piece)
    arguments = ["--drive", "street:10", "--pieces", str(tmp_path), "--out", str(tmp_path / "out")]
    assert main(arguments) == 2
    assert "another drive's?" in capsys.readouterr().err
