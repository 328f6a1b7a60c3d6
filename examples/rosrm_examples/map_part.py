"""Part of a map by one instance of the live SLAM, written to disk at the end of the instance."""

from __future__ import annotations

from dataclasses import asdict, dataclass, fields
from pathlib import Path

from rosrm_examples.arrays import Floats, Points
from rosrm_examples.errors import PieceError
from rosrm_examples.pieces import read_arrays, write_arrays


@dataclass(frozen=True)
class MapPart:
    """A part of a trajectory and of a map, in the frame of the drive's first scan.

    Attributes:
        host: The host that made it.
        times: (S,) seconds.
        poses: (S, 4, 4).
        points: (P, 3) float32 metres, without the restored ones.
        refused: Number of scans that came twice, or too late.
    """

    host: str
    times: Floats
    poses: Floats
    points: Points
    refused: int


def save_part(path: Path, part: MapPart) -> None:
    """Write a part atomically: a reader finds either nothing or all of it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    write_arrays(path, asdict(part))


def load_part(path: Path) -> MapPart:
    """Read a part; raises PieceError where there is none or it is damaged."""
    arrays = read_arrays(path, [field.name for field in fields(MapPart)])
    return MapPart(
        host=str(arrays["host"]),
        times=arrays["times"],
        poses=arrays["poses"],
        points=arrays["points"],
        refused=int(arrays["refused"]),
    )


def load_parts(folder: Path) -> list[MapPart]:
    """Read all parts in a folder, in the order of the drive.

    Raises:
        PieceError: there is none, or one is damaged.
    """
    parts = [load_part(path) for path in folder.glob("*.npz")]
    if not parts:
        raise PieceError(f"{folder}: no part of a map is here")
    return sorted(parts, key=lambda part: float(part.times[0]))
