"""Pose and velocity of the scanner as nav_msgs/Odometry, and back."""

from __future__ import annotations

import numpy as np
from geometry_msgs.msg import Point, Quaternion, Vector3
from nav_msgs.msg import Odometry

from rosrm_examples.arrays import Floats
from rosrm_examples.poses import Pose, make_pose, quaternion, rotation_from_quaternion
from rosrm_examples.stamps import stamp_of

MAP_FRAME, LIDAR_FRAME = "map", "lidar"


def odometry_message(pose: Pose, velocity: Floats, t: float) -> Odometry:
    """Pack a pose and a velocity.

    Args:
        pose: Of the sensor in the map's frame.
        velocity: (6,) in the sensor's frame: m/s along and rad/s about x, y, z.
        t: Seconds.
    """
    x, y, z = (float(value) for value in pose[:3, 3])
    qx, qy, qz, qw = quaternion(pose[:3, :3])
    speed = [float(value) for value in velocity]
    message = Odometry()
    message.header.stamp = stamp_of(t)
    message.header.frame_id = MAP_FRAME
    message.child_frame_id = LIDAR_FRAME
    message.pose.pose.position = Point(x=x, y=y, z=z)
    message.pose.pose.orientation = Quaternion(x=qx, y=qy, z=qz, w=qw)
    message.twist.twist.linear = Vector3(x=speed[0], y=speed[1], z=speed[2])
    message.twist.twist.angular = Vector3(x=speed[3], y=speed[4], z=speed[5])
    return message


def pose_of(message: Odometry) -> Pose:
    """Unpack the (4, 4) pose."""
    position, turn = message.pose.pose.position, message.pose.pose.orientation
    return make_pose(
        rotation_from_quaternion(turn.x, turn.y, turn.z, turn.w),
        np.array([position.x, position.y, position.z]),
    )


def velocity_of(message: Odometry) -> Floats:
    """Unpack the (6,) velocity."""
    linear, angular = message.twist.twist.linear, message.twist.twist.angular
    return np.array([linear.x, linear.y, linear.z, angular.x, angular.y, angular.z])
