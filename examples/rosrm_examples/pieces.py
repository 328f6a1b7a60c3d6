"""A mapped piece of a drive, as `map_piece` writes it to disk and `merge` joins it."""

from __future__ import annotations

import os
import zipfile
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from rosrm_examples.arrays import Arrays, Floats, Keys, Points
from rosrm_examples.errors import PieceError


@dataclass(frozen=True)
class MapPiece:
    """The map and the trajectory of one piece, in the frame of the piece's first scan.

    Attributes:
        number: Of the piece, from 1.
        of: Number of pieces of the drive.
        indices: (S,) numbers of its scans in the whole drive.
        times: (S,) seconds.
        poses: (S, 4, 4).
        points: (P, 3) float32 metres, the map.
    """

    number: int
    of: int
    indices: Keys
    times: Floats
    poses: Floats
    points: Points


def piece_path(folder: Path, number: int) -> Path:
    """Return the path of a piece in the folder of pieces."""
    return folder / f"piece_{number:02d}.npz"


def save_piece(folder: Path, piece: MapPiece) -> Path:
    """Write a piece into a folder atomically: a reader finds either nothing or all of it."""
    path = piece_path(folder, piece.number)
    write_arrays(path, {field.name: getattr(piece, field.name) for field in fields(piece)})
    return path


def write_arrays(path: Path, arrays: Mapping[str, ArrayLike]) -> None:
    """Write an .npz atomically: a reader finds either nothing or all of it."""
    unfinished = path.with_suffix(f".{os.getpid()}.tmp")
    named: dict[str, Any] = {name: np.asarray(value) for name, value in arrays.items()}
    try:
        with unfinished.open("wb") as file:
            np.savez(file, **named)
        unfinished.replace(path)
    finally:
        unfinished.unlink(missing_ok=True)


def read_arrays(path: Path, names: Iterable[str]) -> Arrays:
    """Read arrays by name; raises PieceError where one is missing or damaged."""
    try:
        with np.load(path, allow_pickle=False) as archive:
            return {name: archive[name] for name in names}
    except (OSError, KeyError, ValueError, zipfile.BadZipFile) as error:
        raise PieceError(f"{path}: not a piece of a map: {error}") from error


def load_piece(path: Path) -> MapPiece:
    """Read a piece; raises PieceError where there is none or it is damaged."""
    arrays = read_arrays(path, [field.name for field in fields(MapPiece)])
    return MapPiece(
        number=int(arrays["number"]),
        of=int(arrays["of"]),
        indices=arrays["indices"],
        times=arrays["times"],
        poses=arrays["poses"],
        points=arrays["points"],
    )


def load_pieces(folder: Path) -> list[MapPiece]:
    """Read all pieces of a drive from a folder; raises PieceError where one is missing."""
    paths = sorted(folder.glob("piece_*.npz"))
    if not paths:
        raise PieceError(f"{folder}: no pieces (piece_01.npz, ...) are here")
    pieces = sorted((load_piece(path) for path in paths), key=lambda piece: piece.number)
    numbers, of = [piece.number for piece in pieces], pieces[0].of
    if numbers != list(range(1, of + 1)):
        raise PieceError(f"{folder}: pieces 1 to {of} are needed, found are {numbers}")
    return pieces
