"""A short, seeded run of the chaos benchmark: real faults in a lab, judged by the real oracle."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import uuid
from pathlib import Path

import pytest

from tests.integration.lab.conftest import why_not

ROOT = Path(__file__).resolve().parents[2]
COMMAND = [sys.executable, "-m", "benchmarks.chaos"]
#: Seconds: on a quiet machine it takes 90.
LONGEST = 600.0
KEYS = {"faults", "violations", "lost", "doubled", "orphans", "seed", "minutes", "by_kind"}
SEED, FAULTS = 741, 9


@pytest.fixture
def lab():
    """Yield the name of a lab; check that the benchmark has removed the lab."""
    from rosrm_lab import all_labs

    reason = why_not()
    if reason:
        pytest.skip(f"needs root and what a lab is made of: {reason}")
    name = f"t-{uuid.uuid4().hex[:8]}"
    yield name
    assert [one.name for one in all_labs() if one.name == name] == []


@pytest.mark.slow
@pytest.mark.timeout(LONGEST + 60)
def test_a_few_faults_break_no_promise(lab, tmp_path):
    """The last line of output is the report; without a violation the exit status is 0."""
    command = [*COMMAND, "--seed", str(SEED), "--faults", str(FAULTS), "--minutes", "5"]
    ended = subprocess.run(
        [*command, "--lab", lab, "--out", str(tmp_path)],
        check=False, capture_output=True, text=True, cwd=ROOT, timeout=LONGEST,
    )  # fmt: skip
    told = [path.read_text() for path in tmp_path.glob("violation-*/violation.json")]
    assert ended.returncode == 0, "\n".join([ended.stderr, *told])
    report = json.loads(ended.stdout.splitlines()[-1])
    assert report.keys() >= KEYS
    assert (report["violations"], report["seed"]) == (0, SEED)
    assert sum(report["by_kind"].values()) == report["faults"] >= FAULTS


@pytest.mark.slow
@pytest.mark.timeout(240)
def test_a_signal_leaves_nothing(lab, tmp_path):
    """A signal during the run removes the lab; the fixture checks this."""
    process = subprocess.Popen(
        [*COMMAND, "--lab", lab, "--out", str(tmp_path)], stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE, text=True, cwd=ROOT,
    )  # fmt: skip
    said = []
    for line in process.stderr:
        said.append(line)
        if "no deviations" in line:
            break
    process.send_signal(signal.SIGTERM)
    rest = process.communicate(timeout=120)[1]
    assert process.returncode == 128 + signal.SIGTERM, "".join(said) + rest
    assert "stopped by SIGTERM" in rest
    assert "Traceback" not in rest
