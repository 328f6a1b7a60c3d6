"""The job of Table III: LiDAR drives in ten pieces, as commands and as entries of a work file."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from rosrm_examples.drives import load_drive
from rosrm_examples.errors import DriveError
from rosrm_examples.pieces import load_pieces

#: The KITTI drives available; together they have 373 scans and 536 m.
KITTI: Final = ("kitti0001", "kitti0002", "kitti0027")
#: A metre a scan; `--drive street:1000` is the kilometre, and takes hours within small quotas.
STREET: Final = "street:200"
PIECES: Final = 10
_MODULE: Final = "rosrm_examples.map_piece"
_MEMORY: Final = "110MB"


@dataclass(frozen=True)
class Piece:
    """A piece of a drive that is mapped by one process.

    Attributes:
        drive: name or path, as `load_drive` takes it.
        number: of the piece, from 1.
        of: number of pieces of its drive.
    """

    drive: str
    number: int
    of: int

    @property
    def name(self) -> str:
        """Return the name of its process."""
        stem = "".join(one if one.isalnum() else "_" for one in Path(self.drive).stem)
        return f"{stem}_{self.number:02d}"

    def arguments(self, out: Path) -> list[str]:
        """Return the arguments of the mapping program; each drive has a folder below `out`."""
        return [
            "--drive", self.drive, "--piece", str(self.number), "--of", str(self.of),
            "--out", str(self.folder(out)),
        ]  # fmt: skip

    def folder(self, out: Path) -> Path:
        """Return the folder of its result."""
        return out / self.name.rpartition("_")[0]

    def command(self, out: Path) -> list[str]:
        """Return the command that maps it without rosrm."""
        return [sys.executable, "-m", _MODULE, *self.arguments(out)]

    def entry(self, out: Path, directory: Path) -> dict[str, Any]:
        """Return its entry of a work file."""
        return {
            "name": self.name,
            "module": _MODULE,
            "arguments": self.arguments(out),
            "working_directory": str(directory),
            "ros": True,
            "kind": "job",
            "readiness": "running",  # it is a job: its node in the graph is not waited for
            "needs": {"memory": _MEMORY, "cpu": 0},
        }


def shared_out(scans: Sequence[int], pieces: int) -> list[int]:
    """Return the number of pieces of each drive: in proportion, by the largest remainder.

    Args:
        scans: of each drive.
        pieces: in all; at least as many as drives.
    """
    counts = [1] * len(scans)
    while sum(counts) < pieces:  # the drive with the longest pieces is cut once more
        longest = max(range(len(scans)), key=lambda one: (scans[one] / counts[one], -one))
        counts[longest] += 1
    return counts


def pieces_of(drives: Sequence[str], pieces: int = PIECES) -> list[Piece]:
    """Return the pieces; raises `DriveError` for a drive that is missing or too short for them."""
    if len(drives) > pieces:
        raise DriveError(f"{len(drives)} drives are too many for {pieces} pieces: at most {pieces}")
    loaded = [load_drive(name) for name in drives]
    counts = shared_out([len(drive) for drive in loaded], pieces)
    for drive, of in zip(loaded, counts, strict=True):
        drive.piece(1, of)  # raises where the drive is too short
    return [
        Piece(name, number, of)
        for name, of in zip(drives, counts, strict=True)
        for number in range(1, of + 1)
    ]


def drives_at_hand() -> tuple[str, ...]:
    """Return the KITTI drives where all are available, else a simulated street of 200 m."""
    try:
        for name in KITTI:
            load_drive(name)
    except DriveError:
        return (STREET,)
    return KITTI


def scans_mapped(pieces: Sequence[Piece], out: Path) -> int:
    """Return the number of scans in the results, overlaps twice; raises where one is missing."""
    folders = {piece.folder(out) for piece in pieces}
    return sum(len(one.poses) for folder in folders for one in load_pieces(folder))
