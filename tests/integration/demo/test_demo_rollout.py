"""The rollout demo as a user runs it: versions replace each other in mid-drive, and one fails."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from rosrm_examples.rollout_job import HANDOFFS, SLAM
from tests.integration.demo.runs import Run, read_lines, runs_of

Start = Callable[..., Run]
#: A drive of 70 s, as it is played: on a quiet machine the third version is given up after 40 s.
SCANS, RATE = 280, 0.4


@pytest.fixture
def start(tmp_path: Path) -> Iterator[Start]:
    with runs_of("demo_rollout", tmp_path / "out") as runs:
        yield runs


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_no_scan_is_lost_while_versions_come_and_one_is_given_up(start: Start) -> None:
    """Each version hands over the SLAM, and the faulty third one returns to the second."""
    run = start("--drive", f"street:{SCANS}", "--rate", f"{RATE}")
    status, output, errors = run.end(seconds=240.0)
    assert (status, errors) == (0, ""), output
    run.check_clean()

    summary = json.loads((run.out / "summary.json").read_text())
    assert (summary["scans_sent"], summary["scans_processed"]) == (SCANS, SCANS)
    assert (summary["scans_lost"], summary["scans_repeated"]) == (0, 0)
    assert summary["migrations"] == len(summary["gaps_ms"]) == HANDOFFS

    events = read_lines(run.out / "events.jsonl")
    reached = [
        (event["kind"], event["facts"]["version"])
        for event in events
        if event["kind"] in ("application_applied", "application_returns")
    ]
    assert reached == [
        ("application_applied", 1), ("application_applied", 2),
        ("application_returns", 3), ("application_applied", 2),
    ]  # fmt: skip
    moved = [event["process"] for event in events if event["kind"] == "migrated"]
    assert moved.count(SLAM) == HANDOFFS
    assert "replaced on their host" in (run.out / "report.html").read_text()
    assert (run.out / "rollout.png").read_bytes().startswith(b"\x89PNG")
