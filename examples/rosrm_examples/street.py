"""A simulated drive: a laser scanner is ray-cast through a street with houses and parked cars.

Everything but the ground is an upright box. The ground is uneven on purpose: on a flat one every
scan shows the same rings, so that scan matching would find no motion at all. The same seed always
gives the same street, and each scan has its own noise, so that any part of a drive can be made
without the scans before it.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rosrm_examples.arrays import Floats
from rosrm_examples.poses import inverse, make_pose, transform
from rosrm_examples.voxels import thin

SCAN_PERIOD_S = 0.1
SENSOR_HEIGHT_M = 1.7
NEAREST_M, FARTHEST_M = 3.0, 60.0
NOISE_M = 0.02  # standard deviation of a range
VOXEL_M = 0.5

_COLUMNS = 720  # directions around, evenly spaced
_GROUND_M = np.geomspace(3.2, 45.0, 24)  # distances at which the downward beams meet the ground
_UPWARD = np.tan(np.radians(np.linspace(0.5, 22.0, 18)))  # slopes of the other beams
_KERB_IN_SIGHT_M = 25.0
_DEPTH_M = 0.5  # depth of a box below the ground, which is uneven

_BEND_RAD = np.radians(60)
_SHARPEST_M = 40.0  # mean radius of the bend; a short street bends less instead

_WAVES = np.array(  # the ground: height (m), wave numbers along x and y (rad/m), phase (rad)
    [
        [0.25, 0.11, 0.05, 0.3],
        [0.15, -0.06, 0.13, 1.1],
        [0.05, 0.41, 0.22, 2.0],
        [0.04, -0.30, 0.45, 0.7],
        [0.02, 1.30, -0.60, 1.7],
        [0.02, 0.50, 1.40, 2.9],
    ]
)


class Street:
    """A drive of about a metre a scan: straight, then a bend, then straight.

    Attributes:
        times: (S,) seconds from the start.
        truth: (S, 4, 4) poses of the sensor in the frame of its first scan.
    """

    def __init__(self, scans: int, seed: int = 1) -> None:
        """Build the street; scans are cast on demand."""
        self._seed = seed
        self.times: Floats = SCAN_PERIOD_S * np.arange(scans, dtype=np.float64)
        driven = np.cumsum(1.0 + 0.2 * np.sin(np.arange(scans) / 12))
        self._road = _Road(float(driven[-1]))
        self._boxes = _furnish(self._road, np.random.default_rng(seed))
        self._poses = np.array([self._sensor_pose(at) for at in driven])
        self.truth: Floats = inverse(self._poses[0]) @ self._poses

    def scan(self, index: int) -> NDArray[np.float32]:
        """Cast one scan and thin it: (N, 3) float32 metres, sensor frame."""
        pose = self._poses[index]
        rays, reach = _rays(pose[:3, 3])
        for box in self._boxes_near(pose[:3, 3]):
            _shorten(reach, rays, pose[:3, 3], box)
        noise = np.random.default_rng([self._seed, index]).normal(0, NOISE_M, reach.shape)
        reach = reach + noise
        seen = (reach >= NEAREST_M) & (reach <= FARTHEST_M)
        world = pose[:3, 3] + reach[seen][:, None] * rays[seen]
        return thin(transform(inverse(pose), world), VOXEL_M).astype(np.float32)

    def _sensor_pose(self, driven: float) -> Floats:
        """Return the pose of the sensor upright on the ground's slope, looking along the road."""
        x, y, heading = self._road.at(driven)
        ahead = np.array([np.cos(heading), np.sin(heading)])
        left = np.array([-ahead[1], ahead[0]])
        here = np.array([x, y])
        forward = _on_ground(here + 1.5 * ahead) - _on_ground(here - 1.5 * ahead)
        sideways = _on_ground(here + 0.8 * left) - _on_ground(here - 0.8 * left)
        up = np.cross(forward, sideways)
        up /= np.linalg.norm(up)
        forward /= np.linalg.norm(forward)
        rotation = np.column_stack([forward, np.cross(up, forward), up])
        return make_pose(rotation, _on_ground(here) + SENSOR_HEIGHT_M * up)

    def _boxes_near(self, eye: Floats) -> Floats:
        far = np.hypot(self._boxes[:, 0] - eye[0], self._boxes[:, 1] - eye[1])
        kerb = self._boxes[:, 6] - self._boxes[:, 5] < _DEPTH_M + 0.2  # too low to be hit from afar
        near: Floats = self._boxes[far < np.where(kerb, _KERB_IN_SIGHT_M, FARTHEST_M + 8)]
        return near


class _Road:
    """The middle line of the road, by distance driven."""

    def __init__(self, length: float) -> None:
        self.length = length
        self._step = 0.25
        along = np.arange(-60.0, length + 60.0, self._step)
        bend = np.clip((along - 0.3 * length) / (0.5 * length), 0.0, 1.0)
        turn = min(_BEND_RAD, 0.5 * length / _SHARPEST_M)
        self._heading = turn * (3 * bend**2 - 2 * bend**3)
        self._along = along
        self._x = self._step * np.cumsum(np.cos(self._heading))
        self._y = self._step * np.cumsum(np.sin(self._heading))

    def at(self, along: float, left: float = 0.0) -> tuple[float, float, float]:
        """Return x, y (m) and heading (rad) at a distance driven, `left` of the middle."""
        x, y, heading = (
            float(np.interp(along, self._along, line)) for line in (self._x, self._y, self._heading)
        )
        return x - left * np.sin(heading), y + left * np.cos(heading), heading


def _furnish(road: _Road, rng: np.random.Generator) -> Floats:
    """Place all boxes: rows of x, y, heading, half length, half width, bottom, top."""
    boxes: list[list[float]] = []

    def place(along: float, left: float, size: tuple[float, float, float]) -> None:
        """Put a box of length, width and height on the ground, lengthways to the road."""
        x, y, heading = road.at(along, left)
        ground = float(_height(np.array([x, y])))
        length, width, height = size
        boxes.append([x, y, heading, length / 2, width / 2, ground - _DEPTH_M, ground + height])

    for side in (-1, 1):
        along = -50.0 + rng.uniform(0, 10)
        while along < road.length + 50:
            length, setback = rng.uniform(7, 16), rng.uniform(8, 12)
            place(along + length / 2, side * (setback + 4), (length, 8.0, rng.uniform(4, 9)))
            along += length + rng.uniform(2, 9)
        for along in np.arange(-45, road.length + 45, 22.0):
            place(along + rng.uniform(-5, 5), side * 5.4, (0.3, 0.3, 6.0))
        for along in np.arange(-45, road.length + 45, 9.0):
            if rng.uniform() < 0.5:
                at = along + rng.uniform(-1.5, 1.5)
                place(at, side * 3.9, (4.3, 1.8, 0.8))
                place(at - 0.3, side * 3.9, (2.3, 1.6, 1.45))
        for along in np.arange(-50, road.length + 50, 4.0):
            place(along, side * 5.0, (4.0, 0.25, 0.14))
    return np.array(boxes)


def _height(xy: Floats) -> Floats:
    """Return the ground's height, metres, at (..., 2) places."""
    height, kx, ky, phase = _WAVES.T
    waves = np.sin(xy[..., :1] * kx + xy[..., 1:] * ky + phase)
    ground: Floats = waves @ height
    return ground


def _on_ground(xy: Floats) -> Floats:
    """Lift (2,) or (..., 2) places to the (..., 3) points of the ground there."""
    return np.concatenate([xy, _height(xy)[..., None]], axis=-1)


def _rays(eye: Floats) -> tuple[Floats, Floats]:
    """Aim the beams of one turn of the scanner.

    A downward beam is aimed directly at the point of the ground that it hits, so no search is
    necessary. The ground occludes no other part of the ground (a simplification).

    Returns:
        (columns, beams, 3) unit directions; (columns, beams) distances to the ground, metres,
        infinite for a beam into the sky.
    """
    angle = 2 * np.pi / _COLUMNS * np.arange(_COLUMNS)
    around = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    to_ground = _on_ground(eye[:2] + _GROUND_M[:, None] * around[:, None, :]) - eye
    to_sky = np.concatenate(
        [
            np.broadcast_to(around[:, None, :], (_COLUMNS, len(_UPWARD), 2)),
            np.broadcast_to(_UPWARD[:, None], (_COLUMNS, len(_UPWARD), 1)),
        ],
        axis=-1,
    )
    rays = np.concatenate([to_ground, to_sky], axis=1)
    length = np.linalg.norm(rays, axis=-1)
    reach = length.copy()
    reach[:, len(_GROUND_M) :] = np.inf
    return rays / length[..., None], reach


def _shorten(reach: Floats, rays: Floats, eye: Floats, box: Floats) -> None:
    """Shorten the beams that a box blocks (slab test), in place."""
    x, y, heading, half_length, half_width, bottom, top = box
    turn = np.array([[np.cos(heading), np.sin(heading)], [-np.sin(heading), np.cos(heading)]])
    start = turn @ (eye[:2] - [x, y])
    half = np.array([half_length, half_width])
    columns = _columns_towards(turn, start, half)
    aim = rays[columns]
    with np.errstate(divide="ignore", invalid="ignore"):
        flat = aim[..., :2] @ turn.T
        back, front = (-half - start) / flat, (half - start) / flat
        first, last = np.minimum(back, front), np.maximum(back, front)
        enter = np.maximum(first[..., 0], first[..., 1])  # ten times as fast as max(axis=-1)
        leave = np.minimum(last[..., 0], last[..., 1])
        below, above = (bottom - eye[2]) / aim[..., 2], (top - eye[2]) / aim[..., 2]
    enter = np.maximum(enter, np.minimum(below, above))
    leave = np.minimum(leave, np.maximum(below, above))
    hit = (enter <= leave) & (enter > 0) & (enter < reach[columns])
    reach[columns] = np.where(hit, enter, reach[columns])


def _columns_towards(turn: Floats, start: Floats, half: Floats) -> NDArray[np.intp]:
    """Return the columns of beams in whose directions a box lies, seen from outside it."""
    corners = (np.array([[1, 1], [1, -1], [-1, 1], [-1, -1]]) * half - start) @ turn
    angles = np.arctan2(corners[:, 1], corners[:, 0])
    first = angles[0]
    apart = (angles - first + np.pi) % (2 * np.pi) - np.pi
    scale = _COLUMNS / (2 * np.pi)
    low = int(np.floor((first + apart.min()) * scale))
    high = int(np.ceil((first + apart.max()) * scale))
    return np.arange(low, high + 1) % _COLUMNS
