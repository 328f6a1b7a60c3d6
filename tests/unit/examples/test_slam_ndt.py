"""NDT matching, and the voxel map that it uses."""

from __future__ import annotations

import io
import pickle
from functools import partial

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rosrm_examples.arrays import Floats
from rosrm_examples.ndt import NdtMap, derivatives, match, move
from rosrm_examples.poses import Pose, inverse, transform
from rosrm_examples.voxels import thin, voxel_centres, voxel_keys


def bumpy_room(seed: int, count: int = 4000) -> Floats:
    """Return (N, 3) points on a bumpy floor and two walls, metres."""
    rng = np.random.default_rng(seed)
    across = rng.uniform(-12, 12, (count, 3))
    floor, wall = across[: count // 2], across[count // 2 :]
    floor[:, 2] = 0.3 * np.sin(floor[:, 0]) + 0.2 * np.cos(floor[:, 1]) - 2
    wall[::2, 0] = 11 + 0.3 * np.sin(wall[::2, 1])
    wall[1::2, 1] = -11 + 0.3 * np.sin(wall[1::2, 0])
    return across


@pytest.fixture
def room() -> NdtMap:
    """Return a map of the room with 2 m cells."""
    ndt = NdtMap(2.0)
    ndt.insert(bumpy_room(seed=1))
    return ndt


def a_little_off() -> Pose:
    """Return a pose near the one that the room was mapped from."""
    return move(np.eye(4), np.array([0.21, -0.13, 0.08, 0.01, -0.015, 0.03]))


def score_after(room: NdtMap, pose: Pose, points: Floats, motion: Floats) -> float:
    return derivatives(room, move(pose, motion), points).score


def test_the_gradient_is_the_slope_of_the_score(room: NdtMap) -> None:
    """The analytic gradient equals central differences of the score."""
    points, pose, step = bumpy_room(seed=2), a_little_off(), 1e-6
    score = partial(score_after, room, pose, points)
    numeric = [(score(step * axis) - score(-step * axis)) / (2 * step) for axis in np.eye(6)]
    assert derivatives(room, pose, points).gradient == pytest.approx(numeric, rel=1e-4, abs=1e-3)


def test_the_hessian_is_the_curvature_of_the_score(room: NdtMap) -> None:
    """The analytic Hessian equals second differences of the score."""
    # Keep points well inside their cells: the score jumps where a point changes its cell.
    points, pose, step = bumpy_room(seed=2), a_little_off(), 1e-4
    inside = np.abs(transform(pose, points) / room.cell % 1 - 0.5).max(axis=1) < 0.49
    score, axes = partial(score_after, room, pose, points[inside]), step * np.eye(6)
    points = points[inside]
    numeric = np.array([
        [score(i + j) - score(i - j) - score(j - i) + score(-i - j) for j in axes] for i in axes
    ]) / (4 * step**2)  # fmt: skip
    analytic = derivatives(room, pose, points).hessian
    assert analytic == pytest.approx(numeric, rel=1e-3, abs=1e-4 * np.abs(analytic).max())


def test_a_scan_is_found_where_it_was_taken(room: NdtMap) -> None:
    """Matching brings a scan back to its true pose from a guess that is off."""
    true = a_little_off()
    points = transform(inverse(true), bumpy_room(seed=3))
    found = match(room, np.eye(4), points)
    assert np.abs(found - true).max() < 0.01


def test_without_a_map_the_guess_stands() -> None:
    """A scan that meets no cell of the map leaves the pose as it was predicted."""
    guess = a_little_off()
    assert np.array_equal(match(NdtMap(2.0), guess, bumpy_room(seed=1)), guess)


def test_growing_scan_by_scan_gives_the_same_map_as_all_at_once(room: NdtMap) -> None:
    """Insertion is incremental: the order and the portions do not matter."""
    points = bumpy_room(seed=1)
    grown = NdtMap(2.0)
    for portion in np.array_split(points[::-1], 7):
        grown.insert(portion)
    hit, mean, whiten = room.look_up(points)
    hit_grown, mean_grown, whiten_grown = grown.look_up(points)
    assert np.array_equal(hit, hit_grown)
    assert mean_grown == pytest.approx(mean, abs=1e-9)
    assert whiten_grown == pytest.approx(whiten, rel=1e-6, abs=1e-6)


def test_a_map_survives_the_wire_to_the_last_bit(room: NdtMap) -> None:
    """Arrays without pickle, and pickle too, give a map with the very same Gaussians."""
    for portion in np.array_split(bumpy_room(seed=4), 5):
        room.insert(portion)
    wire = io.BytesIO()
    np.savez(wire, allow_pickle=False, **room.to_arrays())
    wire.seek(0)
    with np.load(wire, allow_pickle=False) as archive:
        restored = NdtMap.from_arrays(dict(archive))
    for copy in (restored, pickle.loads(pickle.dumps(room))):
        for ours, theirs in zip(
            room.look_up(bumpy_room(seed=5)), copy.look_up(bumpy_room(seed=5)), strict=True
        ):
            assert np.array_equal(ours, theirs)


@given(
    st.lists(st.tuples(*[st.floats(-1e5, 1e5)] * 3), min_size=1), st.sampled_from([0.25, 0.5, 2.0])
)
def test_a_key_says_which_voxel(points: list[tuple[float, float, float]], size: float) -> None:
    """Every point lies in the voxel that its key names."""
    array = np.array(points)
    assert (np.abs(voxel_centres(voxel_keys(array, size), size) - array) <= size / 2 + 1e-6).all()


def test_thinning_leaves_the_mean_of_each_voxel() -> None:
    """Points of one voxel become their mean; voxels are kept apart, across zero as well."""
    points = np.array([[0.1, 0.1, 0.1], [0.3, 0.1, 0.2], [-0.1, 0.1, 0.1]])
    assert thin(points, 0.5) == pytest.approx(np.array([[-0.1, 0.1, 0.1], [0.2, 0.1, 0.15]]))
