"""The state of the live SLAM as messages: all of it, or the pose and the newest scans alone.

`full`: `~/state` and `~/state/map` (rosrm_msgs/Arrays); a successor continues exactly as the
original would. `pose`: `~/state` (Odometry) and `~/state/surroundings` (PointCloud2), messages that
other programs can read as well; a successor begins a new map with the newest scans.

Neither includes the trajectory behind the last pose: later results do not depend on it, it would
grow for ever, and each instance writes its own part of it at its end.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Final, NamedTuple

import numpy as np
from nav_msgs.msg import Odometry
from sensor_msgs.msg import PointCloud2

from rosrm.node import arrays_message, arrays_of
from rosrm_examples.arrays import Arrays
from rosrm_examples.clouds import cloud_message, points_of
from rosrm_examples.live_slam import LiveSlam
from rosrm_examples.odometry import LIDAR_FRAME, odometry_message, pose_of, velocity_of
from rosrm_examples.stamps import seconds_of
from rosrm_msgs.msg import Arrays as ArraysMessage


class StateTopic(NamedTuple):
    """One part of the state.

    Attributes:
        name: Of the topic.
        type: Of the message.
        save: Makes the message; None: unchanged since the last one.
        restore: Overwrites the state with the content of a message.
    """

    name: str
    type: type
    save: Callable[[], Any]
    restore: Callable[[Any], None]


def full_state(live: LiveSlam) -> list[StateTopic]:
    """Return the motion, sent with every scan, and the map (megabytes), sent on change."""
    saved_at: int | None = None  # keyframes in the map that was saved last

    def save_motion() -> ArraysMessage:
        return arrays_message(live.slam.motion_state(newest=1))

    def restore_motion(message: ArraysMessage) -> None:
        live.take_over_motion(arrays_of(message))

    def save_map() -> ArraysMessage | None:
        nonlocal saved_at
        if saved_at == live.slam.keyframes:
            return None
        saved_at = live.slam.keyframes
        return arrays_message(live.slam.map_state())

    def restore_map(message: ArraysMessage) -> None:
        nonlocal saved_at
        saved_at = None
        live.take_over_map(arrays_of(message))

    return [
        StateTopic("~/state", ArraysMessage, save_motion, restore_motion),
        StateTopic("~/state/map", ArraysMessage, save_map, restore_map),
    ]


def pose_state(live: LiveSlam) -> list[StateTopic]:
    """Return pose, velocity and surroundings, as standard messages."""

    def save_pose() -> Odometry:
        if live.time is None:
            return Odometry()  # without a frame: there was no scan yet
        return odometry_message(live.pose, live.slam.velocity, live.time)

    def restore_pose(message: Odometry) -> None:
        live.take_over_motion(_motion_of(message))

    def save_surroundings() -> PointCloud2:
        return cloud_message(live.surroundings(), live.time or 0.0, LIDAR_FRAME)

    def restore_surroundings(message: PointCloud2) -> None:
        live.take_over_surroundings(points_of(message))

    return [
        StateTopic("~/state", Odometry, save_pose, restore_pose),
        StateTopic("~/state/surroundings", PointCloud2, save_surroundings, restore_surroundings),
    ]


def _motion_of(message: Odometry) -> Arrays:
    begun = bool(message.header.frame_id)
    return {
        "poses": np.array([pose_of(message)] if begun else []).reshape(-1, 4, 4),
        "times": np.array([seconds_of(message.header.stamp)] if begun else []),
        "velocity": velocity_of(message),
    }


STATES: Final[Mapping[str, Callable[[LiveSlam], list[StateTopic]]]] = {
    "full": full_state,
    "pose": pose_state,
}
