"""A ROS 2 node that plays a drive: it publishes the scans as a scanner would.

    python -m rosrm_examples.player --drive kitti0001 --rate 0.5
    python -m rosrm_examples.player --drive street:200 --hz 20 --subscribers 2

It waits until a node subscribes to `points` (sensor_msgs/PointCloud2), publishes scan by scan in
the drive's own time, that time scaled, or so many a second, and ends when all have arrived. Exit
status: 0 when every scan was sent, 1 when no node subscribed, 2 when the arguments cannot be used,
and 128 + signal number when SIGINT or SIGTERM stopped it.
"""

from __future__ import annotations

import signal

if __name__ == "__main__":
    signal.signal(signal.SIGINT, signal.SIG_DFL)  # no traceback while the imports below run

import argparse
import json
import math
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.utilities import remove_ros_args
from sensor_msgs.msg import PointCloud2

from rosrm_examples.arrays import Floats
from rosrm_examples.clouds import SCANS_QOS, cloud_message
from rosrm_examples.drives import Drive, load_drive
from rosrm_examples.errors import ExampleError
from rosrm_examples.lean_node import lean_node
from rosrm_examples.odometry import LIDAR_FRAME
from rosrm_examples.stopping import StopSignals

_PROGRESS_SCANS: Final = 10
_LOOK_S: Final = 0.05
#: Seconds that the end waits for slow readers, at most.
_ARRIVE_S: Final = 10.0


def main(arguments: Sequence[str] | None = None) -> int:
    """Play a drive; return the exit status."""
    raw = list(sys.argv if arguments is None else ["player", *arguments])
    options = _parse(remove_ros_args(raw)[1:])
    stop = StopSignals()
    try:
        drive = load_drive(options.drive)
        with lean_node("player", raw) as node:
            sent = _play(drive, node, options, stop)
        if options.report is not None:
            options.report.write_text(json.dumps({"scans_sent": sent}) + "\n")
    except (ExampleError, OSError) as error:
        print(f"player: {error}", file=sys.stderr)
        return 2
    print(f"sent {sent} of {len(drive)} scans", flush=True)
    if stop.came is not None:
        return 128 + stop.came
    return 0 if sent == len(drive) else 1


def _parse(arguments: Sequence[str]) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m rosrm_examples.player")
    parser.add_argument("--drive", required=True, help="name or path of the drive")
    pace = parser.add_mutually_exclusive_group()
    pace.add_argument("--rate", type=_positive, default=1.0, help="times as fast as it was driven")
    pace.add_argument("--hz", type=_positive, help="so many scans a second instead")
    parser.add_argument(
        "--subscribers", type=int, default=1, help="wait for so many (default: 1; 0: for none)"
    )
    parser.add_argument("--wait", type=_positive, default=60.0, help="seconds, at the longest")
    parser.add_argument("--report", type=Path, help="file for the number of scans sent, JSON")
    return parser.parse_args(arguments)


def _positive(text: str) -> float:
    number = float(text)
    if not 0 < number < math.inf:
        raise argparse.ArgumentTypeError(f"{text} is not a number above 0")
    return number


def schedule(times: Floats, rate: float, hz: float | None) -> Floats:
    """Return the time at which each scan is due, seconds after the first.

    Args:
        times: (S,) of the scans, seconds.
        rate: times as fast as they were.
        hz: so many a second instead.
    """
    due: Floats = (times - times[0]) / rate if hz is None else np.arange(len(times)) / hz
    return due


def _play(drive: Drive, node: Node, options: argparse.Namespace, stop: StopSignals) -> int:
    """Publish the scans; return their number."""
    publisher = node.create_publisher(PointCloud2, "points", SCANS_QOS)
    if not _has_subscribers(publisher, options.subscribers, options.wait, stop):
        return 0
    started = time.monotonic()
    sent = 0
    due = schedule(drive.times, options.rate, options.hz)
    for points, t, at in zip(drive.scans(), drive.times, due, strict=True):
        message = cloud_message(points, float(t), LIDAR_FRAME)
        time.sleep(max(0.0, started + at - time.monotonic()))
        if stop.came is not None:
            break
        publisher.publish(message)
        sent += 1
        if sent % _PROGRESS_SCANS == 0:
            print(f"{sent}/{len(drive)} scans", flush=True)
    publisher.wait_for_all_acked(Duration(seconds=_ARRIVE_S))
    return sent


def _has_subscribers(publisher: Any, subscribers: int, longest: float, stop: StopSignals) -> bool:
    """Wait for so many subscribers; report where they do not come."""
    deadline = time.monotonic() + longest
    while publisher.get_subscription_count() < subscribers:
        if stop.came is not None:
            return False
        if time.monotonic() >= deadline:
            print(
                f"player: {publisher.get_subscription_count()} of {subscribers} subscribers of "
                f"{publisher.topic_name} came within {longest:g} s",
                file=sys.stderr,
            )
            return False
        time.sleep(_LOOK_S)
    return True


if __name__ == "__main__":
    sys.exit(main())
