"""A ROS 2 node that maps one piece of a LiDAR drive and exits.

    python -m rosrm_examples.map_piece --drive kitti0001 --piece 2 --of 6 --out out/pieces

It publishes the pose of every scan on `odometry` (nav_msgs/Odometry) and writes piece_02.npz at its
end. Exit status: 0 when the piece is written, 2 when the arguments cannot be used, and 128 + signal
number when SIGINT or SIGTERM stopped it before that; then nothing is written.
"""

from __future__ import annotations

import os
import signal

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before numpy: a process should use one core
if __name__ == "__main__":
    signal.signal(signal.SIGINT, signal.SIG_DFL)  # no traceback while the imports below run

import argparse
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from nav_msgs.msg import Odometry
from rclpy.node import Node
from rclpy.utilities import remove_ros_args

from rosrm_examples.drives import DEFAULT_OVERLAP, Drive, load_drive
from rosrm_examples.errors import ExampleError
from rosrm_examples.lean_node import lean_node
from rosrm_examples.odometry import odometry_message
from rosrm_examples.pieces import MapPiece, save_piece
from rosrm_examples.slam import Slam
from rosrm_examples.stopping import StopSignals

PROGRESS_SCANS = 10


def main(arguments: Sequence[str] | None = None) -> int:
    """Map a piece; return the exit status."""
    raw = list(sys.argv if arguments is None else ["map_piece", *arguments])
    options = _parse(remove_ros_args(raw)[1:])
    stop = StopSignals()
    try:
        piece = load_drive(options.drive).piece(options.piece, options.of, options.overlap)
        options.out.mkdir(parents=True, exist_ok=True)  # a failure is reported before the work
        with lean_node("map_piece", raw) as node:
            slam = _map(piece, node, options.rate, stop)
        if stop.came is not None:
            print(f"stopped by {signal.Signals(stop.came).name}, nothing written", flush=True)
            return 128 + stop.came
        path = save_piece(options.out, _result(options.piece, options.of, piece, slam))
    except (ExampleError, OSError) as error:
        print(f"map_piece: {error}", file=sys.stderr)
        return 2
    print(f"wrote {path}: {len(slam.poses)} scans", flush=True)
    return 0


def _parse(arguments: Sequence[str]) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m rosrm_examples.map_piece")
    parser.add_argument("--drive", required=True, help="name or path of the drive")
    parser.add_argument("--piece", required=True, type=int, help="which piece, from 1")
    parser.add_argument("--of", required=True, type=int, help="number of pieces")
    parser.add_argument("--out", required=True, type=Path, help="folder for piece_KK.npz")
    parser.add_argument(
        "--overlap", type=int, default=DEFAULT_OVERLAP, help="scans shared with the next piece"
    )
    parser.add_argument(
        "--rate", type=float, default=0.0, help="scans a second at most; 0: as fast as it can"
    )
    return parser.parse_args(arguments)


def _map(piece: Drive, node: Node, rate: float, stop: StopSignals) -> Slam:
    """Run SLAM over a piece and publish each pose, up to the end or a signal."""
    publisher = node.create_publisher(Odometry, "odometry", 10)
    slam = Slam()
    started, cpu_before = time.monotonic(), time.process_time()
    for done, (points, t) in enumerate(zip(piece.scans(), piece.times, strict=True), start=1):
        if stop.came is not None:
            break
        slam.add_scan(points, float(t))
        publisher.publish(odometry_message(slam.poses[-1], slam.velocity, slam.times[-1]))
        if done % PROGRESS_SCANS == 0 or done == len(piece):
            cpu = (time.process_time() - cpu_before) / done
            print(f"{done}/{len(piece)} scans, {cpu:.3f} s of CPU a scan", flush=True)
        if rate > 0:
            time.sleep(max(0.0, started + done / rate - time.monotonic()))
    return slam


def _result(number: int, of: int, piece: Drive, slam: Slam) -> MapPiece:
    return MapPiece(
        number=number,
        of=of,
        indices=piece.indices,
        times=piece.times,
        poses=np.array(slam.poses),
        points=slam.map_points(),
    )


if __name__ == "__main__":
    sys.exit(main())
