"""Error of live SLAM's trajectory by a migration, at every scan of a drive, for two states.

`full`: a successor with the whole state must have, after one more scan, exactly the state of the
original, and so after all later ones. `pose`: a successor with only the pose and the newest scans
maps the rest of the drive, and its largest distance from the original counts. No ROS graph is used:
the state moves as the serialized messages that the node would publish.
"""

from __future__ import annotations

import sys

import numpy as np
from rclpy.serialization import deserialize_message, serialize_message

from benchmarks.machine import parser, percentile, print_report, say
from benchmarks.stopping import run
from rosrm_examples.drives import Drive, load_drive
from rosrm_examples.errors import ExampleError
from rosrm_examples.live_slam import LiveSlam
from rosrm_examples.slam_state import STATES
from rosrm_examples.stamps import seconds_of, stamp_of


class Instance:
    """Live SLAM with its state as it is published."""

    def __init__(self, state: str) -> None:
        self.live = LiveSlam()
        self._topics = STATES[state](self.live)
        self._published: dict[str, bytes] = {}

    def add(self, drive: Drive, index: int) -> None:
        """Map one scan, and publish the state."""
        self.live.add_scan(drive.read(index), seconds_of(stamp_of(float(drive.times[index]))))
        for topic in self._topics:
            message = topic.save()
            if message is not None:
                self._published[topic.name] = serialize_message(message)

    def state(self) -> dict[str, bytes]:
        return dict(self._published)

    def take_over(self, state: dict[str, bytes]) -> None:
        for topic in self._topics:
            topic.restore(deserialize_message(state[topic.name], topic.type))

    def knows_the_same_as(self, other: Instance) -> bool:
        """Return True if motion and map are equal to the last bit."""
        pairs = (
            (self.live.slam.motion_state(newest=1), other.live.slam.motion_state(newest=1)),
            (self.live.slam.map_state(), other.live.slam.map_state()),
        )
        return all(
            mine.keys() == theirs.keys()
            and all(np.array_equal(mine[name], theirs[name]) for name in mine)
            for mine, theirs in pairs
        )


def full_differences(drive: Drive) -> int:
    """Return the number of scans at which a successor with the full state would differ."""
    original, differing = Instance("full"), 0
    original.add(drive, 0)
    for index in range(1, len(drive.times)):
        successor = Instance("full")
        successor.take_over(original.state())
        successor.add(drive, index)
        original.add(drive, index)
        differing += not successor.knows_the_same_as(original)
    return differing


def pose_deviations(drive: Drive, every: int) -> list[float]:
    """Return the largest deviation over the rest of the drive, metres, for each migrated scan.

    The pose moves before that scan.
    """
    original, states = Instance("pose"), []
    for index in range(len(drive.times)):
        states.append(original.state())
        original.add(drive, index)
    poses = np.array(original.live.slam.poses)
    worst = []
    for index in range(1, len(drive.times), every):
        successor = Instance("pose")
        successor.take_over(states[index])
        for later in range(index, len(drive.times)):
            successor.add(drive, later)
        own = successor.live.part("").poses
        apart = np.linalg.norm(own[:, :3, 3] - poses[index:, :3, 3], axis=1)
        worst.append(float(apart.max()))
        say(f"moved before scan {index} of {len(drive.times)}: {worst[-1]:.4f} m at worst")
    return worst


def main() -> int:
    """Measure and print the report; return the exit status."""
    command_line = parser(__doc__)
    command_line.add_argument("--drive", default="street", help="name or path of the drive")
    command_line.add_argument(
        "--every", type=int, default=1, help="pose: migrate at every n-th scan"
    )
    options = command_line.parse_args()
    try:
        drive = load_drive(options.drive)
    except ExampleError as error:
        print(error, file=sys.stderr)
        return 2
    differing = full_differences(drive)
    say(f"full state: {differing} of {len(drive.times) - 1} migrations make a difference")
    worst = pose_deviations(drive, options.every)
    print_report(
        "slam_cuts",
        {
            "drive": drive.name, "scans": len(drive.times),
            "full_moves": len(drive.times) - 1, "full_differing": differing,
            "pose_moves": len(worst), "pose_worst_m": round(max(worst), 4),
            "pose_p50_m": round(percentile(worst, 0.5), 4),
        },
        runs=1,
    )  # fmt: skip
    return 0


if __name__ == "__main__":
    sys.exit(run("slam_cuts", main))
