"""A drive that a player publishes scan by scan while a SLAM node maps it."""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from rosrm import Kind, ProcessSpec
from rosrm_examples.demo_job import NODE_STOP
from rosrm_examples.drives import Drive

PLAYER: Final = "player"


@dataclass(frozen=True)
class PlayedDrive:
    """A drive with the settings for playing and mapping it.

    Attributes:
        drive: to be played.
        rate: times as fast as it was driven.
        out: folder for the maps of the SLAM's instances, absolute.
        report: file for the player's report at its end, absolute.
        working_directory: in which the drive is found.
    """

    drive: Drive
    rate: float
    out: Path
    report: Path
    working_directory: Path

    @property
    def period(self) -> float:
        """Return the seconds between two scans, as played."""
        return float(np.median(np.diff(self.drive.times))) / self.rate

    def player(self, **fields: Any) -> ProcessSpec:
        """Return the player, which plays the drive once, with further fields of its spec."""
        return ProcessSpec(
            name=PLAYER,
            module="rosrm_examples.player",
            arguments=(
                "--drive", self.drive.name, "--rate", f"{self.rate:.6g}",
                "--report", str(self.report),
            ),
            environment={"OMP_NUM_THREADS": "1"},
            working_directory=str(self.working_directory),
            ros=True,
            kind=Kind.JOB,
            stop=NODE_STOP,
            **fields,
        )  # fmt: skip


def add_rate(parser: argparse.ArgumentParser, usual: str) -> None:
    """Add the argument `--rate`; `usual` tells its default, None, in words."""
    parser.add_argument(
        "--rate", type=_rate, help=f"times as fast as it was driven (default: {usual})"
    )


def _rate(text: str) -> float:
    rate = float(text)
    if not 0.05 <= rate <= 20:
        raise argparse.ArgumentTypeError(f"{text} is not within 0.05 to 20")
    return rate
