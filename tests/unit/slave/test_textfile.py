"""The slave's file for the textfile collector of a node exporter."""

from __future__ import annotations

import logging
import re
import stat
from pathlib import Path

import pytest

from rosrm.model.values import InstanceId, InstanceState, InstanceStatus
from rosrm.slave.textfile import PERIOD, HostMetrics, Textfile, text_of

ROOT = Path(__file__).resolve().parents[3]


def status(name, state, restarts=0):
    return InstanceStatus(InstanceId(name, 1), state, restarts=restarts)


METRICS = HostMetrics(
    is_registered=True, is_accepting=False,
    usage={"memory": 0.25}, limits={"memory": 0.8, "cpu": 1},
    instances=(
        status("p", InstanceState.READY, 2), status("q", InstanceState.READY, 1),
        status("r", InstanceState.FAILED, 9),
    ),
)  # fmt: skip


def test_the_text_has_the_values_of_the_host():
    """States without an instance have a value, too, and ended instances do not count restarts."""
    lines = text_of(METRICS, 'a"b\\c').decode().splitlines()

    host = r'host="a\"b\\c"'
    assert f"rosrm_slave_registered{{{host}}} 1" in lines
    assert f"rosrm_slave_accepting{{{host}}} 0" in lines
    assert f'rosrm_slave_usage_ratio{{{host},resource="memory"}} 0.25' in lines
    assert f'rosrm_slave_limit_ratio{{{host},resource="cpu"}} 1' in lines
    assert f'rosrm_slave_instances{{{host},state="ready"}} 2' in lines
    assert f'rosrm_slave_instances{{{host},state="backoff"}} 0' in lines
    assert f"rosrm_slave_restarts{{{host}}} 3" in lines


def test_the_page_has_the_metrics():
    """The page lists name and meaning of each metric, in the same order."""
    page = (ROOT / "docs/reference/metrics.md").read_text()
    found = re.findall(r"^\| `(rosrm_slave_\w+)` \| .*? \| (.*) \|$", page, re.MULTILINE)

    text = text_of(METRICS, "h").decode()
    assert found == re.findall(r"^# HELP (\w+) (.*)$", text, re.MULTILINE)


def test_prometheus_reads_the_text():
    """The parser of Prometheus finds each metric as a gauge."""
    parser = pytest.importorskip("prometheus_client.parser")
    families = list(parser.text_string_to_metric_families(text_of(METRICS, "h\n").decode()))

    assert len(families) == 6
    assert {one.type for one in families} == {"gauge"}
    assert families[0].samples[0].labels == {"host": "h\n"}


def test_the_file_is_replaced_as_a_whole_and_removed_at_the_end(tmp_path):
    """Another user can read the whole file; the slave removes it when it stops."""
    made = Textfile(tmp_path, "h")
    assert made.is_due(0.0)
    made.write(METRICS, 0.0)
    (file,) = tmp_path.iterdir()
    assert (file.name, stat.S_IMODE(file.stat().st_mode)) == ("rosrm_slave_h.prom", 0o644)
    before = file.stat().st_ino
    assert (made.is_due(PERIOD - 0.1), made.is_due(PERIOD)) == (False, True)
    made.write(METRICS, PERIOD)
    assert [one.stat().st_ino for one in tmp_path.iterdir()] != [before]

    made.remove()
    assert list(tmp_path.iterdir()) == []


def test_without_a_directory_nothing_is_written():
    """The default setting is no directory."""
    made = Textfile(Path(), "h")

    assert not made.is_due(0.0)
    made.remove()


def test_a_directory_that_cannot_be_used_is_logged_once(tmp_path, caplog):
    """The slave tries again, and logs when the file is written again."""
    caplog.set_level(logging.INFO)
    directory = tmp_path / "collector"
    made = Textfile(directory, "h")
    for now in (0.0, PERIOD, 2 * PERIOD):
        made.write(METRICS, now)
    directory.write_text("no directory")
    made.write(METRICS, 3 * PERIOD)
    directory.unlink()
    directory.mkdir()
    made.write(METRICS, 4 * PERIOD)
    made.write(METRICS, 5 * PERIOD)

    first, last = (record.getMessage() for record in caplog.records)
    assert first.endswith("cannot be written: No such file or directory; the slave tries again")
    assert last.endswith("rosrm_slave_h.prom is written again")
