"""A drive that a SLAM node maps live, for tests that move or replace the node during the drive."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

from rosrm.errors import Refused
from rosrm.model.values import Kind, ProcessSpec
from rosrm_examples.drives import Drive
from rosrm_examples.map_part import load_parts
from rosrm_examples.migration_results import LiveRun, differences, summarise, unmigrated_poses
from rosrm_examples.observer import Observer
from tests.ros.clusters import Cluster
from tests.waiting import holds_for, wait_until


@dataclass
class LiveMapping:
    """A drive that is played to the process `slam` of a cluster.

    Attributes:
        seconds: duration of the complete drive.
        observer: of every pose that the SLAM publishes.
    """

    cluster: Cluster
    drive: Drive
    seconds: float
    observer: Observer

    @property
    def parts(self) -> Path:
        """Return the folder in which each instance of the SLAM writes its part of the map."""
        return self.cluster.directory / "parts"

    @property
    def _report(self) -> Path:
        return self.cluster.directory / "player.json"

    def play(self) -> None:
        """Begin to play the drive, and wait until the first scans are mapped."""
        self.cluster.wait("slam", "running")
        wait_until(self.observer.publishers, "a publisher of the SLAM")
        command = (
            sys.executable, "-m", "rosrm_examples.player", "--drive", self.drive.name,
            "--hz", f"{len(self.drive) / self.seconds:.3f}", "--report", str(self._report),
        )  # fmt: skip
        self.cluster.submit(ProcessSpec("player", command=command, kind=Kind.JOB))
        self.wait_for_scans(2)

    def wait_for_scans(self, more: int) -> None:
        """Wait until so many more scans are mapped, or all of them."""
        enough = min(len(self.observer.received) + more, len(self.drive))
        wait_until(lambda: len(self.observer.received) >= enough, f"{more} more scans are mapped")

    def check_playing(self) -> None:
        """Check that the drive is not over yet."""
        assert self.cluster.process("player").state == "running", "the drive was over too early"

    def finish(self, handoffs: int) -> None:
        """End drive and SLAM, and check that each scan was mapped once, as by one instance.

        Args:
            handoffs: number of instances that took over from another one.
        """
        received = self.observer.received
        self.wait_for_scans(3)
        with suppress(Refused):  # it was at its end already
            self.cluster.client.cancel(["player"])
        self.cluster.ended("player")
        sent = json.loads(self._report.read_text())["scans_sent"]
        wait_until(lambda: len(received) >= sent, "all scans are mapped")
        holds_for(1.0, lambda: len(received) == sent, "no further scan")
        self.cluster.cancel("slam")
        driven = self.drive.part(0, sent)
        period = self.seconds / len(self.drive)
        run = LiveRun(driven, sent, list(received), load_parts(self.parts), period)
        summary = summarise(run, unmigrated_poses(driven), len(run.parts) - 1)
        assert differences(summary, "full", migrations=handoffs) == [], summary
        assert (summary["scans_sent"], summary["scans_processed"]) == (sent, sent)


@contextmanager
def live_mapping(cluster: Cluster, drive: Drive, seconds: float) -> Iterator[LiveMapping]:
    """Yield a mapping with an observer in the domain of the cluster."""
    with closing(Observer(cluster.ros)) as observer:
        yield LiveMapping(cluster, drive, seconds, observer)
