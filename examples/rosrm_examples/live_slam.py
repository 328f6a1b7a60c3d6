"""SLAM on a drive that is still going on, in one of several instances that follow each other."""

from __future__ import annotations

import numpy as np

from rosrm_examples.arrays import Arrays, Points
from rosrm_examples.map_part import MapPart
from rosrm_examples.poses import Pose
from rosrm_examples.slam import Slam


class LiveSlam:
    """Maps scan by scan, and tells what it mapped itself from what it took over.

    Attributes:
        slam: The mapping.
        last_scan: (N, 3) metres, sensor frame, as seen from the newest pose; None: there was none.
        refused: Scans that were not later than the one before.
    """

    def __init__(self) -> None:
        """Begins a new map."""
        self.slam = Slam()
        self.last_scan: Points | None = None
        self.refused = 0
        self._first_own = 0  # position of the first pose that was not taken over
        self._map_before: Arrays = {}

    @property
    def pose(self) -> Pose:
        """Where the sensor is."""
        return self.slam.poses[-1]

    @property
    def time(self) -> float | None:
        """Of the newest scan, seconds; None: there was none."""
        return self.slam.times[-1] if self.slam.times else None

    def add_scan(self, points: Points, t: float) -> None:
        """Takes the next scan.

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
        self.last_scan = points

    def _begin_map(self) -> None:
        """Without a map, but with a pose: the scan that was seen from there is the first of it."""
        if self.slam.poses and not self.slam.has_map and self.last_scan is not None:
            self.slam.add_to_map(self.last_scan)
            self._map_before = self.slam.map_state()  # that scan was mapped by somebody else

    # --- taking over -----------------------------------------------------------------------

    def take_over_motion(self, state: Arrays) -> None:
        """Goes on from a trajectory and a velocity, see `Slam.motion_state`."""
        self.slam.restore_motion(state)
        self._first_own = len(self.slam.poses)

    def take_over_map(self, state: Arrays) -> None:
        """Goes on with a map, see `Slam.map_state`."""
        self.slam.restore_map(state)
        self._map_before = state

    def take_over_scan(self, points: Points | None) -> None:
        """Goes on without a map, from the last scan: (N, 3) metres, sensor frame."""
        self.take_over_map({})
        self.last_scan = points

    # --- the end ---------------------------------------------------------------------------

    def part(self, host: str) -> MapPart:
        """Returns what this instance mapped."""
        poses = self.slam.poses[self._first_own :]
        return MapPart(
            host=host,
            times=np.array(self.slam.times[self._first_own :]),
            poses=np.array(poses).reshape(-1, 4, 4),
            points=self.slam.map_points_since(self._map_before),
            refused=self.refused,
        )
