"""The demo as a user runs it: its output files, and no other traces."""

from __future__ import annotations

import json
import re
import signal
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from rosrm_examples.street import Street
from tests.integration.demo.runs import Run, read_lines, runs_of

Start = Callable[..., Run]


@pytest.fixture
def start(tmp_path: Path) -> Iterator[Start]:
    with runs_of("demo", tmp_path / "out") as runs:
        yield runs


@pytest.mark.slow
@pytest.mark.timeout(240)
def test_a_short_demo_fills_the_hosts_maps_the_drive_and_migrates(start: Start) -> None:
    run = start("--drive", "street:36", "--pieces", "3", "--pace", "2")
    status, output, errors = run.end(seconds=180.0)
    assert (status, errors) == (0, ""), output
    run.check_clean()

    summary = json.loads((run.out / "summary.json").read_text())
    processes = summary["processes"]
    assert processes["submitted"] == processes["finished"] > 3
    assert processes["failed"] == 0
    assert summary["hosts"] == 3
    assert summary["assignments"] >= processes["submitted"]
    assert 0 < summary["makespan_s"] < 180
    assert summary["map_points"] > 1000
    assert 0 <= summary["end_error_percent"] < 1.5
    assert "summary.json" in output
    assert "the page of this cluster, until the demo ends: http://127.0.0.1:" in output

    events = read_lines(run.out / "events.jsonl")
    assert [event["sequence"] for event in events] == sorted(event["sequence"] for event in events)
    assert sum(event["kind"] == "migrated" for event in events) == summary["migrations"]
    assert summary["migrations"] >= 1
    assert any(event["kind"] == "waits" for event in events), "the hosts were never full"
    assert {event["host"] for event in events if event["kind"] == "assigned"} == {
        "host1", "host2", "host3",
    }  # fmt: skip

    for name in ("map.png", "usage.png"):
        assert (run.out / name).read_bytes().startswith(b"\x89PNG")
    assert (run.out / "map.ply").read_bytes().startswith(b"ply\n")
    page = (run.out / "report.html").read_text()
    assert "Usage of memory" in page
    assert "is over its limit of memory" in page
    assert len(json.loads((run.out / "samples.json").read_text())["samples"]) > 20


@pytest.mark.timeout(300)
def test_ctrl_c_ends_everything_with_one_line(start: Start) -> None:
    run = start("--drive", "street:40", "--pieces", "4")
    run.wait_for("pieces")  # the first line
    run.wait_for("holder")  # the pieces run
    run.look()
    run.demo.send_signal(signal.SIGINT)
    status, _, errors = run.end(seconds=120.0)
    assert status == 130
    assert errors == "demo: stopped by SIGINT\n"
    run.check_clean()
    assert not (run.out / "summary.json").exists()


@pytest.mark.timeout(300)
def test_ctrl_c_while_the_cluster_comes_up(start: Start) -> None:
    run = start("--drive", "street:40", "--pieces", "4")
    run.wait_for("rosrm demo")
    run.demo.send_signal(signal.SIGINT)
    status, _, errors = run.end(seconds=120.0)
    assert (status, errors) == (130, "demo: stopped by SIGINT\n")
    run.check_clean()


@pytest.mark.timeout(300)
def test_a_piece_that_fails_ends_the_demo_and_names_its_log(start: Start, tmp_path: Path) -> None:
    drive = tmp_path / "drive.npz"
    write_thinned(drive, Street(12))
    run = start("--drive", str(drive), "--pieces", "2")
    run.wait_for("rosrm demo")
    drive.unlink()  # the demo has read it, the pieces have not
    status, _, errors = run.end(seconds=120.0)
    assert status == 1
    assert re.match(r"demo: piece_0\d failed on host\d: .*; see \S+\.log\n", errors), errors
    assert "no such file" in errors  # the last line of that log
    assert "Traceback" not in errors
    log = Path(errors.split("; see ")[1].split("\n")[0])
    assert "no such file" in log.read_text()
    run.check_clean()


def write_thinned(path: Path, street: Street) -> None:
    """Write a drive in the format of the thinned KITTI archives."""
    import numpy as np

    scans = [street.scan(number) for number in range(len(street.times))]
    np.savez(
        path,
        xyz_cm=np.round(100 * np.concatenate(scans)).astype(np.int16),
        count=np.array([len(scan) for scan in scans]),
        t=street.times,
        T_world_velo=street.truth,
    )
