"""Times of scans as seconds and as ROS time stamps, without loss between the two."""

from __future__ import annotations

from builtin_interfaces.msg import Time

_NS = 1_000_000_000


def stamp_of(t: float) -> Time:
    """Turn seconds into a time stamp, to the nearest nanosecond."""
    whole = int(t)
    return from_nanoseconds(whole * _NS + round((t - whole) * _NS))


def from_nanoseconds(nanoseconds: int) -> Time:
    """Turn nanoseconds into a time stamp."""
    return Time(sec=nanoseconds // _NS, nanosec=nanoseconds % _NS)


def nanoseconds_of(stamp: Time) -> int:
    """Turn a time stamp into nanoseconds, which distinguish scans."""
    return int(stamp.sec) * _NS + int(stamp.nanosec)


def seconds_of(stamp: Time) -> float:
    """Turn a time stamp into seconds."""
    return float(stamp.sec) + float(stamp.nanosec) / _NS
