"""LiDAR SLAM by NDT: one scan in, one pose out; its whole state can be saved and restored."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from rosrm_examples.arrays import Arrays, Floats, Points
from rosrm_examples.ndt import NdtMap, match
from rosrm_examples.poses import (
    Pose,
    inverse,
    make_pose,
    rotation_from_vector,
    transform,
    vector_from_rotation,
)
from rosrm_examples.voxels import VoxelCloud

STATE_FORMAT = 1


@dataclass(frozen=True)
class SlamSettings:
    """The parameters; the defaults are those that measured best on KITTI.

    Attributes:
        cells: Edge of the map cells, metres, from coarse to fine. The coarsest finds an unknown
            motion (2 m between scans), the finest determines the accuracy of the map.
        strides: Every how many points are matched at each level.
        keyframe_m: A scan enters the map when the sensor has moved this far, metres.
        cloud_voxel_m: Voxel of the point cloud that is kept for output, metres.
    """

    cells: tuple[float, ...] = (8.0, 4.0, 2.0)
    strides: tuple[int, ...] = (8, 4, 1)
    keyframe_m: float = 1.0
    cloud_voxel_m: float = 0.5


class Slam:
    """A map of a drive, built scan by scan, in the frame of its first scan.

    Each scan is predicted with constant velocity, matched against the map from coarse to fine,
    and added to the map when it is a keyframe.

    Attributes:
        poses: The pose of each scan so far.
        times: The time of each scan, seconds.
        velocity: (6,) of the sensor in its own frame: m/s along and rad/s about x, y, z.
        keyframes: Number of scans that have entered the map since this object was made.
    """

    def __init__(self, settings: SlamSettings | None = None) -> None:
        """Start at the identity with an empty map."""
        self.settings = settings or SlamSettings()
        self.poses: list[Pose] = []
        self.times: list[float] = []
        self.velocity: Floats = np.zeros(6)
        self.keyframes = 0
        self._levels: list[NdtMap]
        self._cloud: VoxelCloud
        self._keyframe: Floats | None
        self._clear_map()

    def add_scan(self, points: Points, t: float) -> Pose:
        """Map the next scan and return the sensor's pose.

        Args:
            points: (N, 3) metres, sensor frame; points that are not finite are left out.
            t: Time of the scan, seconds, later than the last one's.

        Returns:
            The (4, 4) pose of the sensor in the frame of the first scan.
        """
        if self.times and t <= self.times[-1]:
            raise ValueError(f"scan at {t} s: it must be later than the last, {self.times[-1]} s")
        points = points[np.isfinite(points).all(axis=1)]
        pose = self._predict(t)
        for ndt, stride in zip(self._levels, self.settings.strides, strict=True):
            pose = match(ndt, pose, points[::stride])
        self._follow(pose, t)
        if self._is_keyframe(pose):
            self.add_to_map(points)
        return pose

    def add_to_map(self, points: Points) -> None:
        """Add (N, 3) sensor points to the map at the present pose."""
        pose = self.poses[-1]
        world = transform(pose, points)
        for ndt in self._levels:
            ndt.insert(world)
        self._cloud.insert(world)
        self._keyframe = pose[:3, 3]
        self.keyframes += 1

    @property
    def has_map(self) -> bool:
        """Return True if there is a map to match a scan against."""
        return self._keyframe is not None

    def map_points_since(self, earlier: Arrays) -> Points:
        """Return the points added since an earlier `map_state`: (M, 3) float32 metres."""
        if "cloud_keys" not in earlier:
            return self.map_points()
        points = self._cloud.points_since(earlier["cloud_keys"], earlier["cloud_rows"])
        return points.astype(np.float32)

    def map_points(self) -> Points:
        """Return the map so far, thinned: (M, 3) float32 metres, frame of the first scan."""
        return self._cloud.points().astype(np.float32)

    def state(self, with_map: bool = True) -> Arrays:
        """Return the whole state by name; without the map it is small, but not exact."""
        state: Arrays = {"format": np.array(STATE_FORMAT), **self.motion_state()}
        for field in fields(self.settings):
            state[f"settings_{field.name}"] = np.array(getattr(self.settings, field.name))
        if with_map:
            state.update(self.map_state())
        return state

    def motion_state(self, newest: int | None = None) -> Arrays:
        """Return the trajectory and the velocity by name.

        Args:
            newest: Number of poses, the last ones; one is enough to continue from. None: all.
        """
        first = 0 if newest is None else max(0, len(self.poses) - newest)
        return {
            "poses": np.array(self.poses[first:]).reshape(-1, 4, 4),
            "times": np.array(self.times[first:]),
            "velocity": self.velocity.copy(),
        }

    def map_state(self) -> Arrays:
        """Return the map by name; empty before the first keyframe."""
        if self._keyframe is None:
            return {}
        state: Arrays = {
            "keyframe": self._keyframe.copy(),
            "cloud_keys": self._cloud.table.keys,
            "cloud_rows": self._cloud.table.rows.copy(),
        }
        for level, ndt in enumerate(self._levels):
            for name, array in ndt.to_arrays().items():
                state[f"level{level}_{name}"] = array
        return state

    @classmethod
    def from_state(cls, state: Arrays) -> Slam:
        """Restore the result of `state`: the copy continues exactly as the original would."""
        if int(state["format"]) != STATE_FORMAT:
            raise ValueError(f"SLAM state of format {state['format']}: only {STATE_FORMAT} is read")
        slam = cls(_settings_from(state))
        slam.restore_motion(state)
        slam.restore_map(state)
        return slam

    def restore_motion(self, state: Arrays) -> None:
        """Overwrite trajectory and velocity with the result of `motion_state`."""
        self.poses = list(state["poses"].copy())
        self.times = state["times"].tolist()
        self.velocity = state["velocity"].copy()

    def restore_map(self, state: Arrays) -> None:
        """Overwrite the map with the result of `map_state`."""
        if "keyframe" not in state:
            self._clear_map()
            return
        self._keyframe = state["keyframe"].copy()
        self._cloud.table.keys = state["cloud_keys"]
        self._cloud.table.rows = state["cloud_rows"].copy()
        for level in range(len(self._levels)):
            prefix = f"level{level}_"
            arrays = {n[len(prefix) :]: a for n, a in state.items() if n.startswith(prefix)}
            self._levels[level] = NdtMap.from_arrays(arrays)

    def _clear_map(self) -> None:
        self._levels = [NdtMap(cell) for cell in self.settings.cells]
        self._cloud = VoxelCloud(self.settings.cloud_voxel_m)
        self._keyframe = None  # position of the sensor at the last keyframe

    def _predict(self, t: float) -> Pose:
        """Extrapolate the last pose with constant velocity."""
        if not self.poses:
            return np.eye(4)
        step = self.velocity * (t - self.times[-1])
        predicted: Pose = self.poses[-1] @ make_pose(rotation_from_vector(step[3:]), step[:3])
        return predicted

    def _follow(self, pose: Pose, t: float) -> None:
        """Append the pose, and derive the velocity from it."""
        if self.poses:
            step = inverse(self.poses[-1]) @ pose
            elapsed = t - self.times[-1]
            self.velocity = (
                np.concatenate([step[:3, 3], vector_from_rotation(step[:3, :3])]) / elapsed
            )
        self.poses.append(pose)
        self.times.append(t)

    def _is_keyframe(self, pose: Pose) -> bool:
        if self._keyframe is None:
            return True
        return bool(np.linalg.norm(pose[:3, 3] - self._keyframe) >= self.settings.keyframe_m)


def _settings_from(state: Arrays) -> SlamSettings:
    return SlamSettings(
        cells=tuple(state["settings_cells"].tolist()),
        strides=tuple(state["settings_strides"].tolist()),
        keyframe_m=float(state["settings_keyframe_m"]),
        cloud_voxel_m=float(state["settings_cloud_voxel_m"]),
    )
