"""SLAM on a live drive, in one of several instances that succeed each other."""

from __future__ import annotations

from collections import deque
from typing import Final

import numpy as np

from rosrm_examples.arrays import Arrays, Points
from rosrm_examples.map_part import MapPart
from rosrm_examples.poses import Pose, inverse, transform
from rosrm_examples.slam import Slam

#: Scans from which a map can be begun in mid-drive. With the last one alone the next pose may be
#: 0.12 m off those of the whole map on KITTI 0001; with five 0.03 m, and none later 0.09 m.
_RECENT_SCANS: Final = 5
#: Most points of them; otherwise they would grow with each migration.
_RECENT_POINTS: Final = 100_000


class LiveSlam:
    """A mapping, scan by scan, that separates its own part from the restored one.

    Attributes:
        slam: The mapping.
        refused: Number of scans that were not later than the one before.
    """

    def __init__(self) -> None:
        """Begin a new map."""
        self.slam = Slam()
        self.refused = 0
        self._first_own = 0  # position of the first pose that was not restored
        self._map_before: Arrays = {}
        self._recent: deque[tuple[Pose, Points]] = deque(maxlen=_RECENT_SCANS)
        self._seen_before: Points = np.zeros((0, 3), np.float32)

    @property
    def pose(self) -> Pose:
        """Return the pose of the sensor."""
        return self.slam.poses[-1]

    @property
    def time(self) -> float | None:
        """Return the time of the newest scan, seconds; None: there was none."""
        return self.slam.times[-1] if self.slam.times else None

    def add_scan(self, points: Points, t: float) -> None:
        """Add the next scan.

        Args:
            points: (N, 3) metres, sensor frame.
            t: Seconds.

        Raises:
            ValueError: it is not later than the last one, and was left out.
        """
        if self.time is not None and t <= self.time:
            self.refused += 1
        else:
            self._begin_map()
        self.slam.add_scan(points, t)
        self._recent.append((self.pose, points))

    def _begin_map(self) -> None:
        """Insert the restored surroundings as the first keyframe, if there is a pose but no map."""
        if self.slam.poses and not self.slam.has_map:
            self._recent.append((self.pose, self._seen_before))
            self.slam.add_to_map(self._seen_before)
            self._map_before = self.slam.map_state()  # mapped by a predecessor

    def surroundings(self) -> Points:
        """Return the newest scans in one frame: (N, 3) float32 metres, sensor frame."""
        if not self._recent:
            return self._seen_before
        here = inverse(self.pose)
        clouds = [transform(here @ pose, points) for pose, points in reversed(self._recent)]
        return np.concatenate(clouds)[:_RECENT_POINTS].astype(np.float32)

    # --- restoring -------------------------------------------------------------------------

    def take_over_motion(self, state: Arrays) -> None:
        """Restore trajectory and velocity, see `Slam.motion_state`."""
        self.slam.restore_motion(state)
        self._first_own = len(self.slam.poses)

    def take_over_map(self, state: Arrays) -> None:
        """Restore a map, see `Slam.map_state`."""
        self.slam.restore_map(state)
        self._map_before = state

    def take_over_surroundings(self, points: Points) -> None:
        """Restore `surroundings` instead of a map; the pose is restored separately."""
        self.take_over_map({})
        self._recent.clear()
        self._seen_before = points

    # --- the end ---------------------------------------------------------------------------

    def part(self, host: str) -> MapPart:
        """Return the part that this instance mapped."""
        poses = self.slam.poses[self._first_own :]
        return MapPart(
            host=host,
            times=np.array(self.slam.times[self._first_own :]),
            poses=np.array(poses).reshape(-1, 4, 4),
            points=self.slam.map_points_since(self._map_before),
            refused=self.refused,
        )
