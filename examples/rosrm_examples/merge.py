"""Joins the mapped pieces of a drive into one trajectory and one map.

    python -m rosrm_examples.merge --drive kitti0001 --pieces out/pieces --out out

leaves map.ply, map.png and trajectory.npz in the output folder and prints, as its last line, one
JSON object. Each piece starts at its own identity; the scans that it shares with the piece before
it say where it lies.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from rosrm_examples.arrays import Floats, Keys, Points
from rosrm_examples.drives import Drive, load_drive
from rosrm_examples.errors import ExampleError, PieceError
from rosrm_examples.picture import draw_map
from rosrm_examples.pieces import MapPiece, load_pieces
from rosrm_examples.ply import write_ply
from rosrm_examples.poses import Pose, inverse, mean_pose, transform
from rosrm_examples.voxels import thin

MAP_VOXEL_M = 0.3


@dataclass(frozen=True)
class JoinedMap:
    """A whole drive, in the frame of its first scan.

    Attributes:
        indices: (S,) scan numbers.
        times: (S,) seconds.
        poses: (S, 4, 4).
        points: (P, 3) float32 metres.
    """

    indices: Keys
    times: Floats
    poses: Floats
    points: Points


def join(pieces: Sequence[MapPiece]) -> JoinedMap:
    """Chain pieces, in order, through the scans that neighbours share.

    A scan in two pieces is taken from the earlier one, because its map was fuller by then.
    """
    first = pieces[0]
    indices, times, poses = first.indices, first.times, first.poses
    clouds = [first.points]
    for piece in pieces[1:]:
        place = _place(piece, indices, poses)
        new = ~np.isin(piece.indices, indices)
        indices = np.concatenate([indices, piece.indices[new]])
        times = np.concatenate([times, piece.times[new]])
        poses = np.concatenate([poses, place @ piece.poses[new]])
        clouds.append(transform(place, piece.points))
    points = thin(np.concatenate(clouds), MAP_VOXEL_M).astype(np.float32)
    return JoinedMap(indices, times, poses, points)


def end_error_percent(poses: Floats, truth: Floats) -> float:
    """Return the distance of the end from the true end, in percent of the true path's length.

    Args:
        poses: (S, 4, 4); compared relative to the first, as the truth is.
        truth: (S, 4, 4).
    """
    end = (inverse(poses[0]) @ poses[-1])[:3, 3]
    true_end = (inverse(truth[0]) @ truth[-1])[:3, 3]
    length = np.linalg.norm(np.diff(truth[:, :3, 3], axis=0), axis=1).sum()
    return float(100 * np.linalg.norm(end - true_end) / length)


def write_map(joined: JoinedMap, drive: Drive, out: Path) -> dict[str, float | int | None]:
    """Write map.ply, map.png and trajectory.npz; return the figures of the summary."""
    truth = None if drive.truth is None else _truth_of(joined, drive)
    error = None if truth is None else end_error_percent(joined.poses, truth)
    out.mkdir(parents=True, exist_ok=True)
    write_ply(out / "map.ply", joined.points)
    np.savez(out / "trajectory.npz", indices=joined.indices, times=joined.times, poses=joined.poses)
    draw_map(
        out / "map.png",
        joined.points,
        joined.poses[:, :3, 3],
        None if truth is None else truth[:, :3, 3],
        _title(drive, joined, error),
    )
    return {
        "scans": len(joined.indices),
        "map_points": len(joined.points),
        "end_error_percent": None if error is None else round(error, 3),
    }


def main(arguments: Sequence[str] | None = None) -> int:
    """Join the pieces in a folder; return the exit status."""
    parser = argparse.ArgumentParser(prog="python -m rosrm_examples.merge", description=__doc__)
    parser.add_argument("--drive", required=True, help="the drive that the pieces are of")
    parser.add_argument("--pieces", required=True, type=Path, help="folder of piece_KK.npz")
    parser.add_argument("--out", required=True, type=Path, help="folder to write to")
    options = parser.parse_args(arguments)
    try:
        drive = load_drive(options.drive)
        figures = write_map(join(load_pieces(options.pieces)), drive, options.out)
    except (ExampleError, OSError) as error:
        print(f"merge: {error}", file=sys.stderr)
        return 2
    print(json.dumps(figures))
    return 0


def _place(piece: MapPiece, indices: Keys, poses: Floats) -> Pose:
    """Return the piece's frame in the frame of the given trajectory."""
    shared, before, within = np.intersect1d(indices, piece.indices, return_indices=True)
    if len(shared) == 0:
        raise PieceError(
            f"piece {piece.number} of {piece.of} starts at scan {piece.indices[0]}, but the "
            f"piece before it ends at scan {indices[-1]}: neighbours must share scans"
        )
    places = [poses[i] @ inverse(piece.poses[j]) for i, j in zip(before, within, strict=True)]
    return mean_pose(np.array(places))


def _truth_of(joined: JoinedMap, drive: Drive) -> Floats:
    """Return the true poses of the joined scans, relative to the first."""
    assert drive.truth is not None
    if not np.isin(joined.indices, drive.indices).all():
        raise PieceError(f"the pieces have scans that drive {drive.name!r} lacks: another drive's?")
    truth = drive.truth[np.searchsorted(drive.indices, joined.indices)]
    relative: Floats = inverse(truth[0]) @ truth
    return relative


def _title(drive: Drive, joined: JoinedMap, error: float | None) -> str:
    title = f"{drive.name}: {len(joined.indices)} scans, {len(joined.points):,} points"
    return title if error is None else f"{title}, end error {error:.2f} % of the path"


if __name__ == "__main__":
    sys.exit(main())
