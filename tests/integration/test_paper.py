"""A figure of the paper on a small lab, measured as users do."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
import uuid
from pathlib import Path

import psutil
import pytest

from tests.integration.lab.conftest import why_not
from tests.programs import require
from tests.waiting import wait_until

ROOT = Path(__file__).resolve().parents[2]
#: Seconds: on a quiet machine it takes 30.
LONGEST = 400.0
COMMAND = [sys.executable, "-m", "benchmarks.paper"]


@pytest.fixture
def lab():
    """Yield the prefix of the labs' names; check that no such lab is left."""
    from rosrm_lab import all_labs

    reason = why_not()
    if reason:
        pytest.skip(f"needs root and what a lab is made of: {reason}")
    name = f"t-{uuid.uuid4().hex[:8]}"
    yield name
    assert [one.name for one in all_labs() if one.name.startswith(name)] == []


@pytest.mark.slow
@pytest.mark.timeout(LONGEST + 60)
def test_a_small_figure_is_measured_and_its_claim_holds(lab, tmp_path):
    """Numbers, picture, report, last line of output and exit status agree."""
    ended = subprocess.run(
        [*COMMAND, "fig6", "--small", "--lab", lab, "--out", str(tmp_path)],
        check=False,
        capture_output=True,
        text=True,
        cwd=ROOT,
        timeout=LONGEST,
    )
    assert ended.returncode == 0, ended.stderr
    report = json.loads((tmp_path / "fig6.json").read_text())
    assert json.loads(ended.stdout.splitlines()[-1]) == report
    assert report["claim_holds"] is True
    assert report["processes"] == sum(report["per_host"].values()) > 3
    assert report["waiting_at_the_end"] > 0
    assert report["simulation"]["replayed_differently"] == 0
    assert "Usage of memory" in (tmp_path / "fig6.html").read_text()
    assert (tmp_path / "fig6.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.timeout(180)
def test_a_signal_leaves_nothing(lab, tmp_path):
    """A signal during a measurement removes the labs; the fixture checks this."""
    process = subprocess.Popen(
        [*COMMAND, "fig7", "--small", "--lab", lab, "--out", str(tmp_path)],
        stderr=subprocess.PIPE,
        text=True,
        cwd=ROOT,
    )
    said = []
    for line in process.stderr:
        said.append(line)
        if "slave 1 is up" in line:
            break
    time.sleep(0.5)  # so that one or two processes exist; their number does not matter
    process.send_signal(signal.SIGTERM)
    rest = process.communicate(timeout=120)[1]
    assert process.returncode == 128 + signal.SIGTERM, "".join(said) + rest
    assert "stopped by SIGTERM" in rest
    assert "Traceback" not in rest


@pytest.mark.timeout(180)
def test_a_signal_ends_the_simulated_slaves_and_their_master(tmp_path):
    """A signal ends the processes of Fig. 9 (no lab), although they have their own sessions."""
    process = subprocess.Popen(
        [*COMMAND, "fig9", "--small", "--out", str(tmp_path / "out")],
        stderr=subprocess.PIPE, text=True, cwd=ROOT, env={**os.environ, "TMPDIR": str(tmp_path)},
    )  # fmt: skip
    try:
        wait_until(
            lambda: any("registered" in log.read_text() for log in tmp_path.glob("*/scale.log")),
            "a simulated slave is registered", 90.0,
        )  # fmt: skip
        started = {one.pid for one in psutil.Process(process.pid).children(recursive=True)}
        assert len(started) >= 3, "the measurement, its master, its simulated slaves"
    finally:
        process.send_signal(signal.SIGTERM)
        said = process.communicate(timeout=60.0)[1]
    assert process.returncode == 128 + signal.SIGTERM, said
    assert "Traceback" not in said
    assert [pid for pid in started if psutil.pid_exists(pid)] == []
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


def test_without_rights_one_message_says_what_is_missing(tmp_path):
    """Without rights nothing starts, and only the output folder is written."""
    drop = []
    if os.geteuid() == 0:
        require("setpriv")
        drop = ["setpriv", "--bounding-set=-all", "--inh-caps=-all"]
    ended = subprocess.run(
        [*drop, *COMMAND, "fig6", "--out", str(tmp_path / "out")],
        check=False,
        capture_output=True,
        text=True,
        cwd=ROOT,
        timeout=60,
    )
    assert ended.returncode == 2
    assert "a lab needs rights that are missing: " in ended.stderr
    assert "CAP_SYS_ADMIN" in ended.stderr
    assert "Traceback" not in ended.stderr
