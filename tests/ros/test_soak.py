"""Growth of a cluster over many jobs, moves and restarts: the short form of `benchmarks.soak`."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
#: Bytes a job. A leak of one small object in each job is below them, one of a message above.
PART, MASTER = 4_000, 8_000
#: Descriptors and threads in 1,000 jobs: one that a sample happens to see is no leak.
FEW = 5.0


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_no_part_grows_with_its_jobs() -> None:
    """After a warm-up, memory, descriptors and threads of all parts grow within wide bounds."""
    work = ("--jobs", "2000", "--moves", "6", "--applies", "4", "--restarts", "3")
    kept = ("--warm-up", "800", "--keep-ended", "300")
    words = [sys.executable, "-m", "benchmarks.soak", *work, *kept]
    done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-4000:]
    figures = json.loads(done.stdout.splitlines()[-1])

    memory = figures["uss_bytes_a_job"]
    bounds = {part: MASTER if part == "master" else PART for part in memory}
    assert {part: memory[part] for part in memory if memory[part] > bounds[part]} == {}
    # Three restarts are too few for a slope of memory: one growth at the first would be one.
    for grown in (figures, figures["over_restarts"]):
        for things in ("descriptors_a_1000_jobs", "threads_a_1000_jobs"):
            assert {part: n for part, n in grown[things].items() if n > FEW} == {}, things
