"""A loss of power at any moment breaks no promise: the short form of `benchmarks.crash`."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.timeout(600)
def test_each_reader_continues_from_what_a_loss_of_power_has_left() -> None:
    """Keys, journal, supervisor and archive, on states of ext4 and XFS at drawn moments."""
    words = ("--share", "0.02", "--each", "4")
    done = subprocess.run(
        [sys.executable, "-m", "benchmarks.crash", *words],
        cwd=ROOT, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.stdout, done.stderr[-4000:]
    figures = json.loads(done.stdout.splitlines()[-1])
    assert figures["faults"] == {}
    assert all(sum(tried.values()) > 0 for tried in figures["states"].values()), figures["states"]
