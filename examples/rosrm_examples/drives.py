"""LiDAR drives by name: KITTI's raw layout, thinned archives, and a simulated street."""

from __future__ import annotations

import os
import re
import zipfile
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rosrm_examples import kitti_raw, street
from rosrm_examples.arrays import Arrays, Floats, Keys
from rosrm_examples.errors import DriveError

KITTI_VARIABLE = "ROSRM_KITTI"
DEFAULT_OVERLAP = 4  # scans that neighbouring pieces share
STREET_SCANS = 100

_SHARED_KITTI = Path("../shared/data/kitti")  # from the root of the repository
_ALLOWED = (
    "'street', 'street:SCANS', 'kittiNNNN' (a drive number, searched in the folder that "
    f"{KITTI_VARIABLE} names), a thinned .npz, or a KITTI raw folder ..._drive_NNNN_sync"
)
_NPZ_ARRAYS = ("xyz_cm", "count", "t", "T_world_velo")


@dataclass(frozen=True)
class Drive:
    """A drive: scans in order, each made or read on demand.

    Attributes:
        name: As given to `load_drive`.
        indices: (S,) number of each scan in the whole drive.
        times: (S,) time of each scan, seconds.
        truth: (S, 4, 4) true poses of the sensor, or None where none are known.
        read: Returns the scan of a number: (N, 3) float32 metres, sensor frame.
    """

    name: str
    indices: Keys
    times: Floats
    truth: Floats | None
    read: Callable[[int], NDArray[np.float32]]

    def __len__(self) -> int:
        """Return the number of scans."""
        return len(self.indices)

    def scans(self) -> Iterator[NDArray[np.float32]]:
        """Yield each scan: (N, 3) float32 metres, sensor frame."""
        return (self.read(int(index)) for index in self.indices)

    def part(self, first: int, end: int) -> Drive:
        """Return the scans from position `first` up to, not including, `end`."""
        cut = slice(first, end)
        truth = None if self.truth is None else self.truth[cut]
        return replace(self, indices=self.indices[cut], times=self.times[cut], truth=truth)

    def piece(self, k: int, of: int, overlap: int = DEFAULT_OVERLAP) -> Drive:
        """Return piece k (1 to `of`) of the drive cut into equal, contiguous pieces.

        Each piece but the last includes the first `overlap` scans of the next one.
        """
        if not 1 <= k <= of:
            raise DriveError(f"piece {k} of {of}: pieces are numbered from 1 to {of}")
        if overlap < 1:
            raise DriveError(f"overlap of {overlap} scans: neighbours must share at least 1")
        if len(self) < 2 * of:
            raise DriveError(
                f"drive {self.name!r} has {len(self)} scans: it can be cut into at most "
                f"{len(self) // 2} pieces, not {of}"
            )
        first, end = len(self) * (k - 1) // of, len(self) * k // of
        return self.part(first, min(end + overlap, len(self)))


def load_drive(name: str | Path) -> Drive:
    """Load a drive by name or path.

    Args:
        name: "street", "street:SCANS", "kittiNNNN", or the path of a thinned .npz or of a KITTI
            raw folder.

    Raises:
        DriveError: There is no such drive, or it is damaged; the text names the expected form.
    """
    drive = _load(str(name))
    late = np.flatnonzero(np.diff(drive.times) <= 0)
    if len(late):
        raise DriveError(
            f"drive {drive.name!r}: scan {drive.indices[late[0] + 1]} is not later than the scan "
            "before it; times must increase"
        )
    return drive


def drive_of(name: str | Path | None) -> Drive:
    """Load a drive by name or path; without one, the default drive."""
    return load_drive(name) if name else default_drive()


def default_drive() -> Drive:
    """Load KITTI 0001 where it can be found, else the simulated street."""
    return load_drive("kitti0001" if _find_kitti("kitti0001") else "street")


def _load(text: str) -> Drive:
    if text == "street" or text.startswith("street:"):
        return _load_street(text)
    if re.fullmatch(r"kitti\d{4}", text):
        path = _find_kitti(text)
        if path is None:
            raise DriveError(
                f"drive {text!r}: not in {_listed(_kitti_folders())}; allowed are {_ALLOWED}"
            )
        return _load_path(path, text)
    if not Path(text).exists():
        raise DriveError(f"drive {text!r}: no such file, folder or name; allowed are {_ALLOWED}")
    return _load_path(Path(text), text)


def _kitti_folders() -> list[Path]:
    """Return the folders to search for KITTI: the variable's, else those beside the repository."""
    named = os.environ.get(KITTI_VARIABLE)
    if named:
        return [Path(named)]
    roots = (Path(__file__).resolve().parents[2], Path.cwd())
    return [root / _SHARED_KITTI for root in dict.fromkeys(roots)]


def _find_kitti(name: str) -> Path | None:
    """Return the path of kittiNNNN: a thinned archive, else a raw folder (of the earliest date)."""
    number = name.removeprefix("kitti")
    for folder in _kitti_folders():
        for pattern in (f"{name}.npz", f"*_drive_{number}_sync", f"*/*_drive_{number}_sync"):
            found = sorted(folder.glob(pattern))
            if found:
                return found[0].resolve()
    return None


def _load_path(path: Path, name: str) -> Drive:
    if path.is_dir():
        return _load_raw(path, name)
    if path.suffix == ".npz":
        return _load_npz(path, name)
    raise DriveError(f"drive {name!r}: {path} is no drive; allowed are {_ALLOWED}")


def _load_street(text: str) -> Drive:
    _, colon, count = text.partition(":")
    if colon and not (count.isdecimal() and int(count) >= 2):
        raise DriveError(f"drive {text!r}: SCANS in 'street:SCANS' is a whole number from 2")
    simulated = street.Street(int(count) if colon else STREET_SCANS)
    return Drive(
        name=text,
        indices=np.arange(len(simulated.times)),
        times=simulated.times,
        truth=simulated.truth,
        read=simulated.scan,
    )


def _load_raw(folder: Path, name: str) -> Drive:
    raw = kitti_raw.RawDrive(folder)
    return Drive(name=name, indices=raw.numbers, times=raw.times, truth=raw.truth, read=raw.scan)


def _load_npz(path: Path, name: str) -> Drive:
    arrays = _read_npz(path)
    xyz_cm, end = arrays["xyz_cm"], np.cumsum(arrays["count"])
    if len(end) == 0 or end[-1] != len(xyz_cm):
        raise DriveError(f"{path}: 'count' must add up to the {len(xyz_cm)} points of 'xyz_cm'")

    def scan(index: int) -> NDArray[np.float32]:
        start = end[index] - arrays["count"][index]
        points: NDArray[np.float32] = xyz_cm[start : end[index]].astype(np.float32)
        points /= 100  # centimetres to metres
        return points

    return Drive(
        name=name,
        indices=np.arange(len(end)),
        times=arrays["t"],
        truth=arrays["T_world_velo"],
        read=scan,
    )


def _read_npz(path: Path) -> Arrays:
    """Read the arrays of a thinned drive, and check their shapes against each other."""
    try:
        with np.load(path, allow_pickle=False) as archive:
            # A scalar becomes an array of one, so that each has a length to compare.
            arrays: Arrays = {name: np.atleast_1d(archive[name]) for name in _NPZ_ARRAYS}
    except KeyError as error:
        raise DriveError(f"{path}: {error}; needed are {_listed(_NPZ_ARRAYS)}") from error
    except (OSError, ValueError, zipfile.BadZipFile) as error:
        raise DriveError(f"{path}: cannot be read as .npz: {error}") from error
    points, scans = len(arrays["xyz_cm"]), len(arrays["count"])
    needed = {
        "xyz_cm": (points, 3),
        "count": (scans,),
        "t": (scans,),
        "T_world_velo": (scans, 4, 4),
    }
    for name, shape in needed.items():
        if arrays[name].shape != shape:
            raise DriveError(f"{path}: {name!r} has shape {arrays[name].shape}, needed is {shape}")
    return arrays


def _listed(names: Iterable[object]) -> str:
    return ", ".join(str(name) for name in names)
