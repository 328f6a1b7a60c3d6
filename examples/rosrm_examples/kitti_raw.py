"""Reader of drives in the layout of KITTI's raw data (A. Geiger et al., IJRR 2013).

    2011_09_26/
      calib_imu_to_velo.txt                       optional, else the nominal mounting is taken
      2011_09_26_drive_0001_sync/
        velodyne_points/timestamps.txt            one line a scan
        velodyne_points/data/0000000000.bin ...   float32 x, y, z, reflectance
        oxts/data/0000000000.txt ...              optional GNSS/INS: lat lon alt roll pitch yaw ...

Scans are thinned as they are read. A drive may lack single scans: the number in a file's name
selects its line and its GNSS/INS packet.
"""

from __future__ import annotations

from datetime import datetime, timezone
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rosrm_examples.arrays import Floats, Keys
from rosrm_examples.errors import DriveError
from rosrm_examples.poses import Pose, inverse, make_pose
from rosrm_examples.voxels import thin

NEAREST_M, FARTHEST_M = 3.0, 60.0  # nearer is the car itself, farther is too sparse
VOXEL_M = 0.5

_EARTH_RADIUS_M = 6378137.0
# From KITTI's drawing of the car: the scanner is 0.81 m ahead of the IMU, 0.32 m to its right and
# 0.80 m above it, with parallel axes (x ahead, y to the left, z up).
_NOMINAL_IMU_IN_VELO = make_pose(np.eye(3), np.array([-0.81, 0.32, -0.80]))


class RawDrive:
    """A drive folder ..._drive_NNNN_sync.

    Attributes:
        numbers: (S,) numbers of the scans that exist.
        times: (S,) unix time in seconds.
        truth: (S, 4, 4) poses of the scanner in the frame of its first scan, or None.
    """

    def __init__(self, folder: Path) -> None:
        """Read everything but the scans."""
        self._scans = folder / "velodyne_points" / "data"
        files = sorted(self._scans.glob("*.bin"))
        if not files:
            raise DriveError(
                f"{folder}: no KITTI raw drive: no scans in velodyne_points/data/*.bin"
            )
        self._files = {_number(file): file for file in files}
        self.numbers: Keys = np.array(sorted(self._files), dtype=np.int64)
        self.times = self._read_times(folder / "velodyne_points" / "timestamps.txt")
        self.truth = self._read_truth(folder)

    def scan(self, number: int) -> NDArray[np.float32]:
        """Read and thin one scan: (N, 3) float32 metres, sensor frame."""
        values = np.fromfile(self._files[number], dtype="<f4")
        if len(values) % 4:
            raise DriveError(
                f"{self._files[number]}: not a whole number of points of 4 float32 values"
            )
        points = values.reshape(-1, 4)[:, :3]
        points = points[np.isfinite(points).all(axis=1)]
        distance = np.linalg.norm(points, axis=1)
        near = points[(distance >= NEAREST_M) & (distance <= FARTHEST_M)]
        return thin(near, VOXEL_M).astype(np.float32)

    def _read_times(self, path: Path) -> Floats:
        try:
            lines = path.read_text().splitlines()
        except OSError as error:
            raise DriveError(f"{path}: the scans' times cannot be read: {error}") from error
        if len(lines) <= self.numbers[-1]:
            raise DriveError(
                f"{path}: {len(lines)} times, needed is one for scan {self.numbers[-1]}"
            )
        return np.array([_unix_time(lines[number], path) for number in self.numbers])

    def _read_truth(self, folder: Path) -> Floats | None:
        packets = [folder / "oxts" / "data" / f"{number:010d}.txt" for number in self.numbers]
        if not all(packet.exists() for packet in packets):
            return None
        rows = [_read_packet(packet) for packet in packets]
        imu_in_velo = _read_calibration(folder.parent / "calib_imu_to_velo.txt")
        velo_in_imu = inverse(imu_in_velo)
        scale = np.cos(np.radians(rows[0][0]))
        velo = [_imu_pose(row, scale) @ velo_in_imu for row in rows]
        return np.array([inverse(velo[0]) @ pose for pose in velo])


def _number(file: Path) -> int:
    if not file.stem.isdecimal():
        raise DriveError(f"{file}: the name of a scan is its number, as in 0000000000.bin")
    return int(file.stem)


def _unix_time(line: str, path: Path) -> float:
    """Turn '2011-09-26 13:02:25.951199337' (UTC, nanoseconds) into unix time in seconds."""
    whole, _, fraction = line.strip().partition(".")
    try:
        moment = datetime.strptime(whole, "%Y-%m-%d %H:%M:%S").replace(tzinfo=timezone.utc)
        return moment.timestamp() + float(f"0.{fraction or 0}")
    except ValueError as error:
        raise DriveError(f"{path}: {line!r} is no time like 2011-09-26 13:02:25.95") from error


def _read_packet(path: Path) -> Floats:
    """Read latitude, longitude (degrees), altitude (m), roll, pitch, yaw (rad)."""
    try:
        values = np.array(path.read_text().split()[:6], dtype=np.float64)
    except (OSError, ValueError) as error:
        raise DriveError(f"{path}: no GNSS/INS packet: {error}") from error
    if len(values) < 6:
        raise DriveError(f"{path}: {len(values)} values, needed are at least 6")
    return values


def _read_calibration(path: Path) -> Pose:
    """Read the IMU's pose in the scanner's frame; without a file, use the nominal one."""
    if not path.exists():
        return _NOMINAL_IMU_IN_VELO
    try:
        named = dict(line.split(":", 1) for line in path.read_text().splitlines()[1:] if line)
        rotation = np.array(named["R"].split(), dtype=np.float64).reshape(3, 3)
        return make_pose(rotation, np.array(named["T"].split(), dtype=np.float64))
    except (KeyError, ValueError) as error:
        raise DriveError(f"{path}: needed are lines 'R:' of 9 and 'T:' of 3 numbers") from error


def _imu_pose(packet: Floats, scale: float) -> Pose:
    """Return the pose of a GNSS/INS packet on the Mercator plane, metres at that latitude."""
    latitude, longitude, altitude, roll, pitch, yaw = packet
    x = scale * _EARTH_RADIUS_M * np.radians(longitude)
    y = scale * _EARTH_RADIUS_M * np.log(np.tan(np.radians(90 + latitude) / 2))
    rotation = _turn(2, yaw) @ _turn(1, pitch) @ _turn(0, roll)
    return make_pose(rotation, np.array([x, y, altitude]))


def _turn(axis: int, angle: float) -> Floats:
    """Return the (3, 3) rotation about one axis by `angle` rad."""
    i, j = [(1, 2), (2, 0), (0, 1)][axis]
    rotation = np.eye(3)
    rotation[i, i] = rotation[j, j] = np.cos(angle)
    rotation[j, i], rotation[i, j] = np.sin(angle), -np.sin(angle)
    return rotation
