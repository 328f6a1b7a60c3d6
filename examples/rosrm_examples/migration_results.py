"""Results of a live drive with migrations: figures, and deviations from a correct run."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Final

import numpy as np

from rosrm_examples.arrays import Floats, Keys
from rosrm_examples.drives import Drive
from rosrm_examples.map_part import MapPart
from rosrm_examples.merge import end_error_percent
from rosrm_examples.observer import ReceivedPose
from rosrm_examples.slam import Slam
from rosrm_examples.stamps import nanoseconds_of, seconds_of, stamp_of

#: Metres; largest allowed difference from the poses without migration, by the migrated state.
LARGEST_DEVIATION_M: Final = {"full": 1e-9, "pose": 0.1}


@dataclass(frozen=True)
class LiveRun:
    """The observations of one live run.

    Attributes:
        drive: that was played.
        sent: scans that the player sent.
        received: poses, in order of arrival.
        parts: the part of each instance of the SLAM, in the order in which they were active.
        period: seconds between two scans, as played.
    """

    drive: Drive
    sent: int
    received: Sequence[ReceivedPose]
    parts: Sequence[MapPart]
    period: float

    def stamps(self) -> list[int]:
        """Return the stamps of all scans of the drive, nanoseconds."""
        return [nanoseconds_of(stamp_of(float(t))) for t in self.drive.times]

    def numbers(self, part: MapPart) -> Keys:
        """Return the (S,) positions of a part's scans in the drive, from 0."""
        played = np.array([seconds_of(stamp_of(float(t))) for t in self.drive.times])
        return np.searchsorted(played, part.times).astype(np.int64)

    def by_stamp(self) -> dict[int, ReceivedPose]:
        """Return the first received pose of each scan."""
        first: dict[int, ReceivedPose] = {}
        for one in self.received:
            first.setdefault(one.stamp, one)
        return first

    def gaps(self) -> list[float]:
        """Return, for each migration, the time between the outputs of source and destination.

        Seconds, less a period; negative where the next output came early. Migrations without the
        last output of the source or the first one of the destination are left out.
        """
        first = self.by_stamp()
        gaps = []
        for source, destination in pairwise(self.parts):
            ends = [nanoseconds_of(stamp_of(float(source.times[-1])))]
            ends.append(nanoseconds_of(stamp_of(float(destination.times[0]))))
            if all(stamp in first for stamp in ends):
                last, next_one = (first[stamp].arrived for stamp in ends)
                gaps.append(next_one - last - self.period)
        return gaps


def unmigrated_poses(drive: Drive) -> Floats:
    """Map a drive in one go, scans and times as a player sends them: (S, 4, 4) poses."""
    slam = Slam()
    for points, t in zip(drive.scans(), drive.times, strict=True):
        slam.add_scan(points, seconds_of(stamp_of(float(t))))
    return np.array(slam.poses)


def summarise(run: LiveRun, unmigrated: Floats, migrations: int) -> dict[str, Any]:
    """Return the figures of `summary.json`.

    Args:
        unmigrated: (S, 4, 4) poses of the same drive without a migration.
        migrations: counted by the master.
    """
    first, gaps = run.by_stamp(), run.gaps()
    refused = sum(part.refused for part in run.parts)
    return {
        "drive": run.drive.name,
        "scans_sent": run.sent,
        "scans_processed": len(first),
        "scans_lost": run.sent - len(first),
        "scans_repeated": len(run.received) - len(first) + refused,
        "out_of_order": sum(b.stamp < a.stamp for a, b in pairwise(run.received)),
        "period_ms": round(1e3 * run.period, 3),
        "gap_ms": round(1e3 * max(gaps), 3) if gaps else None,
        "max_deviation_m": _max_deviation(run, unmigrated),
        "end_error_percent": _end_error(run),
        "migrations": migrations,
        "parts": [
            {"host": part.host, "scans": len(part.times), "points": len(part.points)}
            for part in run.parts
        ],
    }


def differences(summary: dict[str, Any], state: str, migrations: int) -> list[str]:
    """Return the deviations from a correct run, a line each; empty: there are none."""
    # The order of two writers' messages does not count: DDS may resend some of them late.
    expected = {"scans_lost": 0, "scans_repeated": 0, "migrations": migrations}
    wrong = [
        f"{name} is {summary[name]}, not {value}"
        for name, value in expected.items()
        if summary[name] != value
    ]
    mapped = sum(part["scans"] for part in summary["parts"])
    if mapped != summary["scans_sent"]:
        wrong.append(f"the instances mapped {mapped} scans of {summary['scans_sent']}")
    if migrations and summary["gap_ms"] is None:
        wrong.append("no successor has an output right after its source")
    deviation, largest = summary["max_deviation_m"], LARGEST_DEVIATION_M[state]
    if deviation is None or deviation > largest:
        wrong.append(f"max_deviation_m is {deviation}, more than {largest:g}")
    return wrong


def _max_deviation(run: LiveRun, unmigrated: Floats) -> float | None:
    """Return the largest distance, metres; None: no pose was received."""
    first = run.by_stamp()
    apart = [
        float(np.linalg.norm(first[stamp].pose[:3, 3] - pose[:3, 3]))
        for stamp, pose in zip(run.stamps(), unmigrated, strict=True)
        if stamp in first
    ]
    return max(apart, default=None)


def _end_error(run: LiveRun) -> float | None:
    """Return the end error, percent of the path; None: no truth, or some poses are missing."""
    first, stamps = run.by_stamp(), run.stamps()
    if run.drive.truth is None or not all(stamp in first for stamp in stamps):
        return None
    poses = np.array([first[stamp].pose for stamp in stamps])
    return round(end_error_percent(poses, run.drive.truth), 3)
