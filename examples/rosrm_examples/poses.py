"""Rigid poses as 4x4 matrices, and the few operations on them that SLAM needs."""

from __future__ import annotations

from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from rosrm_examples.arrays import Floats, Points

Pose: TypeAlias = NDArray[np.float64]  # (4, 4): rotation and translation (metres), last row 0 0 0 1

_TINY_ANGLE = 1e-9  # rad; below it sin(a)/a is 1 to the last bit


def make_pose(rotation: Floats, translation: Floats) -> Pose:
    """Join a (3, 3) rotation and a (3,) translation, metres."""
    pose = np.eye(4)
    pose[:3, :3] = rotation
    pose[:3, 3] = translation
    return pose


def transform(pose: Pose, points: Points) -> Floats:
    """Transform (N, 3) points from the pose's own frame into the frame that it is given in."""
    moved: Floats = points @ pose[:3, :3].T + pose[:3, 3]
    return moved


def inverse(pose: Pose) -> Pose:
    """Invert a pose; exact in form, unlike a general matrix inverse."""
    rotation = pose[:3, :3].T
    return make_pose(rotation, -rotation @ pose[:3, 3])


def rotation_from_vector(vector: Floats) -> Floats:
    """Turn a (3,) rotation vector, rad, into a (3, 3) rotation (Rodrigues' formula)."""
    angle = float(np.linalg.norm(vector))
    x, y, z = vector
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    if angle < _TINY_ANGLE:
        return np.asarray(np.eye(3) + cross)
    sine, versine = np.sin(angle) / angle, (1 - np.cos(angle)) / angle**2
    rotation: Floats = np.eye(3) + sine * cross + versine * (cross @ cross)
    return rotation


def vector_from_rotation(rotation: Floats) -> Floats:
    """Turn a (3, 3) rotation by less than half a turn into its (3,) rotation vector, rad."""
    twice_axis = np.array(
        [
            rotation[2, 1] - rotation[1, 2],
            rotation[0, 2] - rotation[2, 0],
            rotation[1, 0] - rotation[0, 1],
        ]
    )
    sine = float(np.linalg.norm(twice_axis)) / 2
    angle = float(np.arctan2(sine, (np.trace(rotation) - 1) / 2))
    scale = 0.5 if sine < _TINY_ANGLE else angle / (2 * sine)
    vector: Floats = scale * twice_axis
    return vector


def quaternion(rotation: Floats) -> tuple[float, float, float, float]:
    """Return the unit quaternion x, y, z, w (w >= 0) of a (3, 3) rotation."""
    vector = vector_from_rotation(rotation)
    angle = float(np.linalg.norm(vector))
    scale = 0.5 if angle < _TINY_ANGLE else np.sin(angle / 2) / angle
    x, y, z = (float(part) for part in scale * vector)
    return x, y, z, float(np.cos(angle / 2))


def rotation_from_quaternion(x: float, y: float, z: float, w: float) -> Floats:
    """Turn a quaternion, of unit length but for rounding, into a (3, 3) rotation."""
    x, y, z, w = np.array([x, y, z, w]) / np.sqrt(x * x + y * y + z * z + w * w)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def mean_pose(poses: Floats) -> Pose:
    """Average (S, 4, 4) poses that lie close together (chordal mean of the rotations)."""
    left, _, right = np.linalg.svd(poses[:, :3, :3].mean(axis=0))
    left[:, 2] *= np.linalg.det(left @ right)  # a rotation, never a reflection
    return make_pose(left @ right, poses[:, :3, 3].mean(axis=0))
