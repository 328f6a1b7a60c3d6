"""Point clouds as sensor_msgs/PointCloud2 and back: the same float32 numbers, and quickly."""

from __future__ import annotations

from array import array
from typing import Final

import numpy as np
from numpy.typing import NDArray
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import PointCloud2, PointField

from rosrm_examples.arrays import Points
from rosrm_examples.stamps import stamp_of

#: QoS of scans: while a reader migrates or its host is busy, up to `depth` scans wait for it.
SCANS_QOS: Final = QoSProfile(depth=100, reliability=ReliabilityPolicy.RELIABLE)

_AXES: Final = ("x", "y", "z")
_FLOAT_BYTES: Final = 4
_POINT_BYTES: Final = _FLOAT_BYTES * len(_AXES)


def cloud_message(points: Points, t: float, frame: str) -> PointCloud2:
    """Pack (N, 3) points, metres, as float32 x, y, z.

    Args:
        points: In the axes of `frame`.
        t: Time at which they were seen, seconds.
        frame: Name of the frame.
    """
    message = PointCloud2(height=1, width=len(points), is_dense=True)
    message.header.stamp = stamp_of(t)
    message.header.frame_id = frame
    message.fields = [
        PointField(name=axis, offset=_FLOAT_BYTES * at, datatype=PointField.FLOAT32, count=1)
        for at, axis in enumerate(_AXES)
    ]
    message.point_step = _POINT_BYTES
    message.row_step = _POINT_BYTES * len(points)
    # rclpy takes this array as it is; with bytes it would check each one.
    message.data = array("B", np.ascontiguousarray(points, "<f4").tobytes())
    return message


def points_of(message: PointCloud2) -> NDArray[np.float32]:
    """Unpack the (N, 3) points, metres, of a cloud that may have further fields.

    Raises:
        ValueError: it has no x, y and z of float32, or less data than its header declares.
    """
    layout = np.dtype(
        {
            "names": list(_AXES),
            "formats": [">f4" if message.is_bigendian else "<f4"] * len(_AXES),
            "offsets": _offsets(message),
            "itemsize": int(message.point_step),
        }
    )
    rows, columns = int(message.height), int(message.width)
    if len(message.data) < rows * message.row_step or message.row_step < columns * layout.itemsize:
        raise ValueError(
            f"cloud of {rows} x {columns} points: {len(message.data)} bytes in rows of "
            f"{message.row_step} are too few for points of {layout.itemsize}"
        )
    raw = np.frombuffer(message.data, np.uint8)[: rows * message.row_step].reshape(rows, -1)
    named = np.ascontiguousarray(raw[:, : columns * layout.itemsize]).view(layout).reshape(-1)
    return np.stack([named[axis].astype(np.float32) for axis in _AXES], axis=1)


def _offsets(message: PointCloud2) -> list[int]:
    """Return the offsets of x, y and z within a point, bytes."""
    found = {field.name: field for field in message.fields}
    for axis in _AXES:
        if axis not in found or found[axis].datatype != PointField.FLOAT32:
            raise ValueError(
                f"cloud with fields {', '.join(found) or 'none'}: x, y and z of float32 are needed"
            )
    offsets = [int(found[axis].offset) for axis in _AXES]
    if max(offsets) + _FLOAT_BYTES > message.point_step:
        raise ValueError(f"cloud with points of {message.point_step} bytes: they do not hold z")
    return offsets
