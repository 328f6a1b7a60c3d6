"""Scan matching by the normal distributions transform (NDT), point to distribution (P2D-NDT).

Source: M. Magnusson, "The Three-Dimensional Normal-Distributions Transform", doctoral thesis,
Oerebro University, 2009, chapter 6. A map holds a Gaussian per cell; a scan matches where its
points are most likely under the Gaussians of the cells that they fall into. The match is found by
Newton's method with the analytic gradient and Hessian. Two things differ from the thesis:

- A step is a small motion from the present pose (a shift of the sensor and a turn about it), so
  there are no Euler angles, and the second derivatives are those of the exponential map at zero.
- A flat Gaussian is made thicker by a part of its trace in every direction instead of by a limit
  on its eigenvalues: the same effect without an eigendecomposition.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rosrm_examples.arrays import Arrays, Flags, Floats, Keys, Points
from rosrm_examples.poses import Pose, make_pose, rotation_from_vector
from rosrm_examples.voxels import VoxelTable, sum_by_key, voxel_centres, voxel_keys

MIN_POINTS = 5  # fewer do not define a cell's shape (Magnusson 2009, section 6.2)
OUTLIER_RATIO = 0.55  # part of the points expected off the map (as in Magnusson's code)
THICKEN = 0.03  # of a Gaussian's trace, added to its variance in every direction
NOISE_VARIANCE = 1e-4  # m^2; a range is known to about 1 cm at best

MAX_STEPS = 20
MAX_HALVINGS = 4
SMALL_SHIFT = 5e-3  # m; a shorter step ends the search, well below the noise of a cell
SMALL_TURN = 5e-4  # rad

# Columns of a map's table: the sums, then the Gaussian computed from them.
_SUMS = slice(0, 10)  # count, x, y, z, xx, xy, xz, yy, yz, zz about the cell's centre
_MEAN = slice(10, 13)
_WHITEN = slice(13, 22)  # (3, 3) W by rows, W^T W = inverse covariance
_FULL = [4, 5, 6, 5, 7, 8, 6, 8, 9]  # the columns of the second moments as a (3, 3) matrix


class NdtMap:
    """Gaussians in cubic cells, updated in place with each scan that is inserted."""

    def __init__(self, cell: float) -> None:
        """Start an empty map with cells of `cell` metres."""
        self.cell = cell
        self._table = VoxelTable(22)
        # Magnusson 2009, eqs. 6.7 and 6.8: a Gaussian fitted to the log of a Gaussian plus a
        # constant for outliers, so that a far point loses its pull.
        inlier, outlier = 10 * (1 - OUTLIER_RATIO), OUTLIER_RATIO / cell**3
        self.d1 = float(np.log((inlier + outlier) / outlier))
        middle = np.log((inlier * np.exp(-0.5) + outlier) / outlier)
        self.d2 = float(-2 * np.log(middle / self.d1))

    def insert(self, points: Points) -> None:
        """Add (N, 3) points, metres, in the map's frame."""
        keys = voxel_keys(points, self.cell)
        cells, sums = sum_by_key(keys, _moments(points - voxel_centres(keys, self.cell)))
        rows = self._table.ensure(cells)
        self._table.rows[rows, _SUMS] += sums
        self._fit(rows)

    def look_up(self, points: Points) -> tuple[Flags, Floats, Floats]:
        """Find the Gaussians of the cells that points fall into.

        Returns:
            (N,) True for points with one; for those M: (M, 3) means; (M, 3, 3) whitening W.
        """
        rows = self._table.find(voxel_keys(points, self.cell))
        hit = rows >= 0
        found = self._table.rows[rows[hit]]
        solid = found[:, 0] >= MIN_POINTS
        hit[hit] = solid
        found = found[solid]
        return hit, found[:, _MEAN], found[:, _WHITEN].reshape(-1, 3, 3)

    def to_arrays(self) -> Arrays:
        """Return all data of the map, to be given to `from_arrays`."""
        return {
            "cell": np.array(self.cell),
            "keys": self._table.keys,
            "sums": self._table.rows[:, _SUMS].copy(),
        }

    @classmethod
    def from_arrays(cls, arrays: Arrays) -> NdtMap:
        """Restore a map that matches exactly like the one that `to_arrays` was called on."""
        ndt = cls(float(arrays["cell"]))
        rows = ndt._table.ensure(arrays["keys"])
        ndt._table.rows[:, _SUMS] = arrays["sums"]
        ndt._fit(rows)
        return ndt

    def _fit(self, rows: Keys) -> None:
        """Compute the Gaussians of the given cells from their sums (Magnusson eqs. 6.2, 6.3)."""
        table = self._table
        rows = rows[table.rows[rows, 0] >= MIN_POINTS]
        sums = table.rows[rows, _SUMS]
        count, mean = sums[:, :1], sums[:, 1:4] / sums[:, :1]
        products = (mean[:, :, None] * mean[:, None, :]).reshape(-1, 9)
        covariance = ((sums[:, _FULL] - count * products) / (count - 1)).reshape(-1, 3, 3)
        thickness = THICKEN * np.trace(covariance, axis1=1, axis2=2) + NOISE_VARIANCE
        covariance += thickness[:, None, None] * np.eye(3)
        table.rows[rows, _MEAN] = mean + voxel_centres(table.keys[rows], self.cell)
        whiten = np.linalg.inv(np.linalg.cholesky(covariance))
        table.rows[rows, _WHITEN] = whiten.reshape(-1, 9)


class Derivatives(NamedTuple):
    """The score of a pose and how it changes with a small motion: 3 of shift, 3 of turn."""

    score: float  # lower is better
    gradient: Floats  # (6,)
    hessian: Floats  # (6, 6)


def derivatives(ndt: NdtMap, pose: Pose, points: Points) -> Derivatives:
    """Score (N, 3) sensor points at a pose, with the gradient and Hessian at zero motion.

    Magnusson 2009, eqs. 6.9 to 6.13, with the Jacobian and second derivatives of a small motion
    (see `move`) in place of those of Euler angles.
    """
    arms = points @ pose[:3, :3].T  # from the sensor to each point, in the map's axes
    world = arms + pose[:3, 3]
    hit, mean, whiten = ndt.look_up(world)
    arms = arms[hit]
    offset = np.einsum("nij,nj->ni", whiten, world[hit] - mean)
    likelihood = ndt.d1 * np.exp(-ndt.d2 / 2 * np.einsum("ni,ni->n", offset, offset))
    weight = ndt.d2 * likelihood

    jacobian = np.empty((len(arms), 3, 6))  # of the whitened offset
    jacobian[:, :, :3] = whiten
    for axis, (i, j) in enumerate([(1, 2), (2, 0), (0, 1)]):
        jacobian[:, :, 3 + axis] = (
            arms[:, None, i] * whiten[:, :, j] - arms[:, None, j] * whiten[:, :, i]
        )
    slope = np.einsum("ni,nij->nj", offset, jacobian)
    weighted = weight[:, None] * slope
    root = (np.sqrt(weight)[:, None, None] * jacobian).reshape(-1, 6)
    hessian = root.T @ root - ndt.d2 * (slope.T @ weighted)
    # A turn w bends a point's path by w x (w x arm) = w (w . arm) - arm (w . w).
    bend = weighted[:, :3].T @ arms
    hessian[3:, 3:] += (bend + bend.T) / 2 - np.trace(bend) * np.eye(3)
    return Derivatives(-float(likelihood.sum()), weighted.sum(axis=0), hessian)


def move(pose: Pose, motion: Floats) -> Pose:
    """Shift the sensor by motion[:3], metres, and turn it about itself by motion[3:], rad."""
    return make_pose(rotation_from_vector(motion[3:]) @ pose[:3, :3], pose[:3, 3] + motion[:3])


def match(ndt: NdtMap, guess: Pose, points: Points) -> Pose:
    """Find the pose near `guess` at which (N, 3) sensor points fit the map best.

    Returns the guess where no point is on the map, or no pose is better.
    """
    pose, here = guess, derivatives(ndt, guess, points)
    for _ in range(MAX_STEPS):
        motion = _newton_step(here, ndt.cell)
        for _ in range(MAX_HALVINGS):
            trial = move(pose, motion)
            there = derivatives(ndt, trial, points)
            if there.score <= here.score:
                break
            motion = motion / 2
        else:
            return pose
        pose, here = trial, there
        if np.abs(motion[:3]).max() < SMALL_SHIFT and np.abs(motion[3:]).max() < SMALL_TURN:
            return pose
    return pose


def _newton_step(at: Derivatives, longest: float) -> Floats:
    """Return the (6,) Newton step, downhill even where the Hessian is not positive definite."""
    curvature, axes = np.linalg.eigh(at.hessian)
    steepest = np.abs(curvature).max()
    if steepest == 0:
        return np.zeros(6)
    curvature = np.maximum(np.abs(curvature), 1e-6 * steepest)
    step: Floats = -axes @ ((axes.T @ at.gradient) / curvature)
    shift = float(np.linalg.norm(step[:3]))
    return step * min(1.0, longest / shift) if shift > 0 else step


def _moments(points: Floats) -> Floats:
    """Return (N, 10): one, the coordinates and their products, as summed per cell."""
    x, y, z = points.T
    return np.column_stack([np.ones(len(x)), x, y, z, x * x, x * y, x * z, y * y, y * z, z * z])
