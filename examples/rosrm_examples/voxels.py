"""Cubic voxels: packed integer keys, and tables with a row of numbers per voxel."""

from __future__ import annotations

import numpy as np

from rosrm_examples.arrays import Floats, Keys, Points

_BITS = 21  # per axis: 63 in all, so that a packed key is a non-negative int64
_OFFSET = 1 << (_BITS - 1)  # makes the cell numbers of one axis non-negative
_MASK = (1 << _BITS) - 1


def voxel_keys(points: Points, size: float) -> Keys:
    """Pack the voxel of each point into one integer.

    Args:
        points: (N, 3) metres, finite, within 2^20 voxels of the origin on each axis.
        size: Edge of a voxel, metres.

    Returns:
        (N,) keys, equal exactly where the voxels are equal.
    """
    cell = np.floor(points / size).astype(np.int64) + _OFFSET
    keys: Keys = (cell[:, 0] << (2 * _BITS)) | (cell[:, 1] << _BITS) | cell[:, 2]
    return keys


def voxel_centres(keys: Keys, size: float) -> Floats:
    """Return the (N, 3) centres, metres, of voxels with an edge of `size` metres."""
    cell = np.column_stack([keys >> (2 * _BITS), (keys >> _BITS) & _MASK, keys & _MASK])
    centres: Floats = (cell - _OFFSET + 0.5) * size
    return centres


def sum_by_key(keys: Keys, features: Floats) -> tuple[Keys, Floats]:
    """Add up the (N, C) features of equal keys: (V,) sorted keys, (V, C) sums."""
    if len(keys) == 0:
        return keys, features
    order = np.argsort(keys, kind="stable")
    ordered = keys[order]
    first = np.flatnonzero(np.diff(ordered, prepend=-1))
    return ordered[first], np.add.reduceat(features[order], first, axis=0)


def thin(points: Points, size: float) -> Floats:
    """Replace the (N, 3) points of each voxel of `size` metres by their mean: (V, 3)."""
    _, sums = sum_by_key(voxel_keys(points, size), _with_ones(points))
    return _means(sums)


class VoxelTable:
    """A row of numbers per voxel, found by key; new voxels start at zero.

    Attributes:
        keys: (V,) packed voxels, sorted.
        rows: (V, width) float64.
    """

    def __init__(self, width: int) -> None:
        """Start with an empty table."""
        self.keys: Keys = np.empty(0, np.int64)
        self.rows: Floats = np.empty((0, width))

    def find(self, keys: Keys) -> Keys:
        """Return the (N,) row number of each key, -1 where there is no such voxel."""
        if len(self.keys) == 0:
            return np.full(len(keys), -1)
        at = np.minimum(np.searchsorted(self.keys, keys), len(self.keys) - 1)
        return np.where(self.keys[at] == keys, at, -1)

    def ensure(self, keys: Keys) -> Keys:
        """Add the missing voxels; return the row number of each (sorted) key."""
        missing = keys[self.find(keys) < 0]
        at = np.searchsorted(self.keys, missing)
        self.keys = np.insert(self.keys, at, missing)
        self.rows = np.insert(self.rows, at, 0.0, axis=0)
        return np.searchsorted(self.keys, keys).astype(np.int64)


class VoxelCloud:
    """A point cloud that grows scan by scan and keeps one point, the mean, per voxel."""

    def __init__(self, size: float) -> None:
        """Start empty, with voxels of `size` metres."""
        self.size = size
        self.table = VoxelTable(4)  # count, sum of x, y, z

    def insert(self, points: Points) -> None:
        """Add (N, 3) points, metres."""
        keys, sums = sum_by_key(voxel_keys(points, self.size), _with_ones(points))
        at = self.table.ensure(keys)
        self.table.rows[at] += sums

    def points(self) -> Floats:
        """Return the (V, 3) means, metres."""
        return _means(self.table.rows)

    def points_since(self, keys: Keys, rows: Floats) -> Floats:
        """Return the (W, 3) means, metres, of the points added since an earlier state of the table.

        Args:
            keys: (V,) of the table then.
            rows: (V, 4) of the table then.
        """
        added = self.table.rows.copy()
        added[self.table.find(keys)] -= rows
        return _means(added[added[:, 0] > 0])


def _means(rows: Floats) -> Floats:
    """Divide rows of count, sum of x, y, z by their counts."""
    means: Floats = rows[:, 1:] / rows[:, :1]
    return means


def _with_ones(points: Points) -> Floats:
    return np.column_stack([np.ones(len(points)), points])
