"""Tens of simulated slaves on a real master, which counts every reading."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import psutil
import pytest

from benchmarks import scale as benchmark

ROOT = Path(__file__).resolve().parents[2]
SLAVES = 30
HZ = 10.0


def scale(*words: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "benchmarks.scale", "--settle", "1", *words],
        cwd=ROOT, capture_output=True, text=True, timeout=240.0, check=False,
    )  # fmt: skip


@pytest.fixture(scope="module")
def report() -> dict:
    """Return the benchmark's report of one short run."""
    words = f"--slaves {SLAVES} --hz {HZ} --seconds 4 --processes 2 --settle 3"
    ended = scale(*words.split())
    assert ended.returncode == 0, ended.stderr
    return json.loads(ended.stdout.splitlines()[-1])


def test_every_slave_is_heard_all_the_time(report) -> None:
    """Slaves whose readings hardly change keep their contact, too.

    On a busy machine a simulated slave may pause for longer than its lease.
    """
    assert report["slaves"] == SLAVES
    assert report["hosts_heard"] >= 0.8 * SLAVES


def test_every_cycle_is_accounted_for_or_missed(report) -> None:
    """Cycles reported by the slaves equal those counted by the master, except at the edges.

    The two windows differ by up to a second, and on a busy machine cycles are skipped.
    """
    counted = report["received_per_s"] + report["missed"] / report["seconds"]
    assert counted == pytest.approx(report["offered_per_s"], rel=0.4)
    assert report["offered_per_s"] <= SLAVES * HZ * 1.1


def test_quiet_cycles_cost_no_message(report) -> None:
    """Nearly constant readings are sent at half the rate of cycles, never more rarely."""
    assert 0.45 < report["messages_per_cycle"] < 0.8


def test_each_request_is_answered(report) -> None:
    """An assignment reaches its slave, although all slaves read the topic."""
    assert report["request_process_answered"] == report["request_process_asked"]
    assert 0.0 < report["request_process_p50_ms"] <= report["request_process_p99_ms"]


def test_the_costs_are_of_one_piece(report) -> None:
    """CPU per slave cycle is that of the master over the cycles of the same period."""
    assert report["us_per_message"] == pytest.approx(
        1e6 * report["master_cpu"] / report["received_per_s"]
    )


def test_what_it_was_measured_through_is_told(report) -> None:
    """The transport is that of real hosts, UDP only, where permitted."""
    rights = int(Path("/proc/self/status").read_text().split("CapEff:")[1].split()[0], 16)
    network = "UDPv4, in a network namespace" if rights >> 21 & 1 else "default, LOCALHOST"
    assert report["transports"] == network


def test_a_run_that_fails_says_why_in_its_last_line() -> None:
    """A failed start, here by a timeout of the registration, is explained in the last line."""
    ended = scale("--slaves", "3", "--timeout", "0.001")
    assert ended.returncode == 2
    assert "of 2 registered in 0.001 s" in ended.stderr
    assert ended.stderr.splitlines()[-1] == (
        "benchmarks.scale: simulated slaves ended with exit code 2; see above"
    )
    assert "Traceback" not in ended.stderr


def test_a_signal_ends_all_that_it_has_started(tmp_path) -> None:
    """The benchmark names the signal, and leaves none of its processes."""
    process = subprocess.Popen(
        [sys.executable, "-m", "benchmarks.scale", "--slaves", "4", "--settle", "100"],
        cwd=ROOT, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True,
        env={**os.environ, "TMPDIR": str(tmp_path)},
    )  # fmt: skip
    assert process.stderr is not None
    assert "4 slaves are registered" in process.stderr.readline()
    started = {one.pid for one in psutil.Process(process.pid).children(recursive=True)}
    assert len(started) >= 3
    process.send_signal(signal.SIGTERM)
    _, said = process.communicate(timeout=60.0)
    assert process.returncode == 128 + signal.SIGTERM
    assert said.splitlines()[-1] == "benchmarks.scale: stopped by SIGTERM"
    assert [pid for pid in started if psutil.pid_exists(pid)] == []
    assert list(tmp_path.iterdir()) == []


def test_readings_that_move_all_go_out() -> None:
    """A changed reading is always sent (a reading at its bounds does not change)."""
    ended = scale("--slaves", "10", "--seconds", "4", "--processes", "1", "--step", "0.1")
    assert ended.returncode == 0, ended.stderr
    assert json.loads(ended.stdout.splitlines()[-1])["messages_per_cycle"] > 0.9


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--slaves", "0"], "0 is not above 0"),
        (["--hz", "-1"], "-1 is not above 0"),
        (["--slaves", "2", "--processes", "3"], "2 slaves cannot share 3 processes"),
        (["--slaves", "many"], "--slaves: invalid"),
    ],
)
def test_bad_arguments_are_refused(monkeypatch, capsys, words, said) -> None:
    """Bad arguments are refused with one line, before anything starts."""
    monkeypatch.setattr(sys, "argv", ["scale", *words])
    with pytest.raises(SystemExit, match="2"):
        benchmark.main()
    assert said in capsys.readouterr().err.splitlines()[-1]
