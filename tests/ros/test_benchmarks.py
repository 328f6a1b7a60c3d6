"""Stopped benchmarks, which must leave nothing of their cluster."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

from tests.ros.clusters import PATIENCE, pids_of, wait_until, wait_until_none

ROOT = Path(__file__).resolve().parents[2]


def test_a_benchmark_that_is_terminated_ends_its_cluster(tmp_path):
    """SIGTERM (from a service manager, a time limit) ends the cluster, as Ctrl-C does."""
    benchmark = subprocess.Popen(
        [sys.executable, "-m", "benchmarks.balance"],
        cwd=ROOT, env={**os.environ, "TMPDIR": str(tmp_path)},
        stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    try:
        wait_until(lambda: len(pids_of(tmp_path)) >= 3, "the benchmark's cluster is there")
        benchmark.send_signal(signal.SIGTERM)
        _, said = benchmark.communicate(timeout=2 * PATIENCE)
    finally:
        benchmark.kill()
        benchmark.wait()
    assert (benchmark.returncode, said) == (143, "benchmarks.balance: stopped by SIGTERM\n")
    assert not wait_until_none(tmp_path)
