"""Metrics of a real cluster: GET /metrics, and `rosrm metrics`."""

from __future__ import annotations

import os
import signal
import stat
import subprocess
import sys
import time

import pytest

from tests.ros.clusters import host, job, service
from tests.ros.web_kit import START_PATIENCE, gateway
from tests.waiting import PATIENCE, wait_until


@pytest.fixture(scope="module")
def collected(tmp_path_factory):
    """Return the directory of a node exporter's textfile collector."""
    return tmp_path_factory.mktemp("collector")


@pytest.fixture(scope="module")
def cluster(make_shared, collected):
    made = make_shared(host("robot-1", textfile=collected))
    made.submit(service("talker"))
    made.wait("talker", "running")
    return made


def command(cluster, *words):
    return subprocess.Popen(
        [sys.executable, "-m", "rosrm.cli", "metrics", *words], text=True,
        env={**os.environ, **cluster.ros.environment()}, stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE, stderr=subprocess.PIPE,
    )  # fmt: skip


def test_a_scrape_has_the_present_and_the_events_since_the_start(cluster):
    """Values of the cluster, and counters that begin with the gateway."""
    with gateway(cluster.ros) as web:
        web.wait_for_master("up")
        answer = web.ask("/metrics")
        lines = answer.body.decode().splitlines()
        assert answer.headers["content-type"].startswith("text/plain; version=0.0.4")
        assert {"rosrm_up 1.0", 'rosrm_host_up{host="robot-1"} 1.0'} <= set(lines)
        assert 'rosrm_processes{state="running"} 1.0' in lines
        assert 'rosrm_events_total{kind="finished"} 0.0' in lines

        wait_until(
            lambda: b"\nrosrm_decision_seconds " in web.ask("/metrics").body,
            "the load of the master has arrived",
        )
        cluster.run(job("short", "true"))
        wait_until(
            lambda: b'rosrm_events_total{kind="finished"} 1.0' in web.ask("/metrics").body,
            "the end of the job is counted",
        )


def test_the_command_prints_metrics_or_replaces_a_file(cluster, tmp_path):
    """The node exporter, another user, can read the file."""
    printed, _ = command(cluster).communicate(timeout=START_PATIENCE)
    assert "rosrm_up 1.0" in printed.splitlines()
    assert "rosrm_events_total" not in printed

    file = tmp_path / "metrics" / "rosrm.prom"
    file.parent.mkdir()
    process = command(cluster, "--textfile", str(file), "--every", "0.1s")
    try:
        wait_until(file.exists, "the file is written", START_PATIENCE)
        before = file.stat().st_ino
        wait_until(lambda: file.stat().st_ino != before, "the file is replaced")
        assert 'rosrm_events_total{kind="finished"}' in file.read_text()
        assert stat.S_IMODE(file.stat().st_mode) == 0o644
        file.parent.rename(tmp_path / "former")  # takes no file for a moment, like a full disk
        time.sleep(0.3)
        file.parent.mkdir()
        wait_until(file.exists, "the file is written again")
    finally:
        process.send_signal(signal.SIGINT)
        assert process.wait(PATIENCE) == 130
    assert [one.name for one in file.parent.iterdir()] == ["rosrm.prom"]


def test_a_slave_writes_the_metrics_of_its_host(cluster, collected):
    """The node exporter of the host can read them beside the metrics of the master."""
    file = collected / "rosrm_slave_robot-1.prom"
    expected = {
        'rosrm_slave_registered{host="robot-1"} 1',
        'rosrm_slave_instances{host="robot-1",state="ready"} 1',
    }
    wait_until(
        lambda: file.exists() and expected <= set(file.read_text().splitlines()),
        "the file shows the registered host and its process",
        seen=lambda: file.exists() and file.read_text(),
    )  # fmt: skip
    assert 'rosrm_slave_usage_ratio{host="robot-1",resource="memory"} ' in file.read_text()


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (("--every", "1s"), "--every: give the file too"),
        (("--every", "soon", "--textfile", "x"), "--every: "),
        (("--textfile", "/nowhere/x.prom"), "--textfile /nowhere/x.prom: cannot be written"),
    ],
)
def test_a_wrong_option_is_one_sentence(cluster, words, says):
    """Exit code 2, and nothing is printed."""
    process = command(cluster, *words)
    out, error = process.communicate(timeout=START_PATIENCE)

    assert (process.returncode, out) == (2, "")
    assert error.startswith(f"rosrm: {says}")
