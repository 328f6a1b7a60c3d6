"""The migration demo as a user runs it: the SLAM moves in mid-drive without losing a scan."""

from __future__ import annotations

import json
import signal
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from tests.integration.demo.runs import Run, read_lines, runs_of

Start = Callable[..., Run]


@pytest.fixture
def start(tmp_path: Path) -> Iterator[Start]:
    with runs_of("demo_migration", tmp_path / "out") as runs:
        yield runs


@pytest.mark.slow
@pytest.mark.timeout(240)
@pytest.mark.parametrize("state", ["full", "pose"])
def test_the_slam_moves_in_mid_drive(start: Start, state: str) -> None:
    run = start("--drive", "street:60", "--rate", "0.3", "--state", state)
    status, output, errors = run.end(seconds=180.0)
    assert (status, errors) == (0, ""), output
    run.check_clean()

    summary = json.loads((run.out / "summary.json").read_text())
    assert (summary["scans_sent"], summary["scans_processed"]) == (60, 60)
    assert (summary["scans_lost"], summary["scans_repeated"]) == (0, 0)
    assert summary["migrations"] == 1
    assert summary["gap_ms"] is not None
    assert summary["max_deviation_m"] <= {"full": 1e-9, "pose": 0.1}[state]
    assert 0 <= summary["end_error_percent"] < 1.5
    assert [part["host"] for part in summary["parts"]] == ["host1", "host2"]
    assert min(part["scans"] for part in summary["parts"]) > 3
    assert min(part["points"] for part in summary["parts"]) > 1000

    events = read_lines(run.out / "events.jsonl")
    kinds = [event["kind"] for event in events]
    assert kinds.index("over_limit") < kinds.index("migration_begun") < kinds.index("migrated")
    assert "Processes over hosts" in (run.out / "report.html").read_text()
    for name in ("map.png", "trajectory.png"):
        assert (run.out / name).read_bytes().startswith(b"\x89PNG")
    header, _, _ = (run.out / "map.ply").read_bytes().partition(b"end_header")
    points = sum(part["points"] for part in summary["parts"])
    assert f"element vertex {points}".encode() in header
    assert b"uchar blue" in header


@pytest.mark.timeout(300)
def test_ctrl_c_ends_the_migration_demo(start: Start) -> None:
    run = start("--drive", "street:60", "--rate", "0.3")
    run.wait_for("scans mapped, on host1")
    run.look()
    run.demo.send_signal(signal.SIGINT)
    status, _, errors = run.end(seconds=120.0)
    assert (status, errors) == (130, "demo_migration: stopped by SIGINT\n")
    run.check_clean()
    assert not (run.out / "summary.json").exists()
