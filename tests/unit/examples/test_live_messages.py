"""Scans and poses as ROS messages: equal numbers on both sides."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("rclpy")

from sensor_msgs.msg import PointCloud2, PointField

from rosrm_examples.clouds import cloud_message, points_of
from rosrm_examples.odometry import odometry_message, pose_of, velocity_of
from rosrm_examples.player import schedule
from rosrm_examples.poses import make_pose, rotation_from_vector
from rosrm_examples.stamps import from_nanoseconds, nanoseconds_of, seconds_of, stamp_of


def cloud(points: int) -> np.ndarray:
    return np.random.default_rng(3).normal(0, 40, (points, 3)).astype(np.float32)


def over_the_wire(message):
    from rclpy.serialization import deserialize_message, serialize_message

    return deserialize_message(serialize_message(message), type(message))


@pytest.mark.parametrize("points", [0, 1, 11000])
def test_a_cloud_keeps_every_bit(points) -> None:
    """NaN is kept, too; scanners send it for "no echo"."""
    given = cloud(points)
    given[:1] = np.nan
    message = over_the_wire(cloud_message(given, 1317042146.25, "lidar"))
    found = points_of(message)
    assert found.dtype == np.float32
    assert found.shape == (points, 3)
    assert found.tobytes() == given.tobytes()
    assert len(message.data) == 12 * points
    assert (message.width, message.header.frame_id) == (points, "lidar")
    assert seconds_of(message.header.stamp) == 1317042146.25


@pytest.mark.parametrize("order", ["<", ">"])
def test_a_cloud_of_a_real_driver(order) -> None:
    """The cloud has further fields, an image of padded rows, and either byte order."""
    given = cloud(6).reshape(2, 3, 3)
    offsets = {"intensity": 0, "x": 4, "y": 8, "z": 12}
    layout = {"names": list(offsets), "formats": [f"{order}f4"] * 4,
              "offsets": list(offsets.values()), "itemsize": 20}  # fmt: skip
    rows = np.zeros((2, 3), np.dtype(layout))
    for axis, name in enumerate("xyz"):
        rows[name] = given[:, :, axis]
    padded = b"".join(row.tobytes() + b"pad!" for row in rows)
    fields = [
        PointField(name=name, offset=offset, datatype=PointField.FLOAT32, count=1)
        for name, offset in offsets.items()
    ]
    message = PointCloud2(
        height=2, width=3, fields=fields, is_bigendian=order == ">", point_step=20, row_step=64,
        data=padded,
    )  # fmt: skip
    assert np.array_equal(points_of(message), given.reshape(-1, 3))


def test_a_cloud_that_is_none_is_refused() -> None:
    """The error has the missing part."""
    good = cloud_message(cloud(2), 0.0, "lidar")
    for changes, said in (
        ({"fields": list(good.fields)[:2]}, "fields x, y: x, y and z of float32"),
        ({"width": 3, "row_step": 36}, "24 bytes in rows of 36 are too few"),
        ({"point_step": 8}, "points of 8 bytes"),
        ({"fields": []}, "fields none"),
    ):
        message = cloud_message(cloud(2), 0.0, "lidar")
        for name, value in changes.items():
            setattr(message, name, value)
        with pytest.raises(ValueError, match=said):
            points_of(message)


@pytest.mark.parametrize("t", [0.0, 0.1, 0.30000000000000004, 1317042146.1416936, 2.0**31 - 1.5])
def test_a_stamp_is_the_time_to_the_nanosecond(t) -> None:
    """A stamp converted to a time and back is the same stamp."""
    stamp = stamp_of(t)
    assert seconds_of(stamp) == pytest.approx(t, abs=1e-9)
    assert stamp_of(seconds_of(stamp)) == stamp
    assert from_nanoseconds(nanoseconds_of(stamp)) == stamp


def test_a_time_just_below_a_second() -> None:
    """Rounding never gives 10^9 nanoseconds."""
    assert (stamp_of(1.9999999999).sec, stamp_of(1.9999999999).nanosec) == (2, 0)


def test_odometry_keeps_pose_and_velocity() -> None:
    """The accuracy is that of a quaternion."""
    pose = make_pose(rotation_from_vector(np.array([0.3, -0.2, 2.9])), np.array([1e3, -2.0, 0.1]))
    velocity = np.arange(6) / 7
    message = over_the_wire(odometry_message(pose, velocity, 12.5))
    assert pose_of(message)[:3, 3].tolist() == pose[:3, 3].tolist()
    assert np.abs(pose_of(message) - pose).max() < 1e-14
    assert velocity_of(message).tolist() == velocity.tolist()
    assert seconds_of(message.header.stamp) == 12.5


def test_a_drive_is_played_in_its_own_time_or_evenly() -> None:
    """The pace is scaled, or a number of scans a second."""
    times = np.array([5.0, 5.1, 5.3])
    assert schedule(times, 2.0, None) == pytest.approx([0.0, 0.05, 0.15])
    assert schedule(times, 1.0, 50.0) == pytest.approx([0.0, 0.02, 0.04])
