"""Metrics: the table, the values of a listing, the counters of events, and what uses them."""

from __future__ import annotations

import json
import re
import subprocess
from pathlib import Path

import pytest
import yaml
from prometheus_client.parser import text_string_to_metric_families

from rosrm.model.event_kinds import EventKind
from rosrm.model.rows import EventRow, HostRow, Listing, ProcessRow, ResourceRow
from rosrm.model.values import HostDescription
from rosrm_web.metrics import counting, sampling, table
from rosrm_web.metrics.exposition import exposition
from tests.programs import needs

ROOT = Path(__file__).resolve().parents[4]
RULES = ROOT / "docs/how-to/rosrm.rules.yaml"
DASHBOARD = ROOT / "docs/how-to/rosrm.grafana.json"
METRICS = {one.name: one for one in (*table.PRESENT, *table.COUNTED)}
needs_promtool = needs("promtool")
#: Ends of the names of the series of a histogram.
SERIES = re.compile(r"_(bucket|sum|count)$")


def resource(name, usage, *, stale=False):
    return ResourceRow(name, "B", 2e9, "machine", usage, 0.1, 0.8, stale)


def process(name, state="running", **more):
    values = {
        "kind": "service", "host": "alpha", "number": 1, "pid": 7 if state == "running" else 0,
        "restarts": 2, "migrations": 0, "exit_code": None, "priority": 0, "queue_position": 0,
        "since": 3.0, "cpu": 0.5, "memory": 64, "reason": "", **more,
    }  # fmt: skip
    return ProcessRow(name=name, state=state, **values)


def event(kind, process="talker", wall=0.0, **facts):
    return EventRow(1, wall, 0.0, str(getattr(kind, "value", kind)), process, "", "", facts)


RESOURCES = (resource("memory", 0.4), resource("cpu", 0.9, stale=True))
HOST = HostRow(HostDescription("alpha", 7), 1, "up", False, True, True, 0.1, RESOURCES, 1)
LOAD = {
    "turn_s": 0.02, "write_s": 0.01, "cpu_s": 5, "oldest_reading_s": 0.2, "missed": 3,
    "decide_s": 0.004, "decisions": 9, "deciding_s": 0.01, "dropped": 1, "strangers": 2,
}  # fmt: skip
OWN = [(table.TOKENS, (), 0.0)]
LISTING = Listing(
    "lab", 60.0, 9, hosts=[HOST],
    processes=[
        process("talker"), process('<b a="1">\\'), process("old", "finished"),
        process("next", "queued", queue_position=1, since=8.0),
        process("last", "queued", queue_position=2, since=5.0),
    ],
)  # fmt: skip


def metric_of(name):
    """Return the metric of a series."""
    return METRICS.get(name) or METRICS[SERIES.sub("", name)]


def values(text):
    """Return the value of each series of a text, by name and labels in the order of the table."""
    return {
        (
            sample.name,
            *(sample.labels[label] for label in metric_of(sample.name).labels),
        ): sample.value
        for family in text_string_to_metric_families(text.decode())
        for sample in family.samples
    }


def test_the_page_has_the_table():
    """Name, kind, labels and meaning of each metric, in order."""
    page = (ROOT / "docs/reference/metrics.md").read_text()
    rows = re.findall(r"^\| `(rosrm_\w+)` \| (\w+) \| (.*?) \| (.*) \|$", page, re.MULTILINE)

    expected = [
        (one.name, one.kind, ", ".join(f"`{name}`" for name in one.labels), one.meaning)
        for one in METRICS.values()
    ]
    assert [(name, kind, labels.strip(), says) for name, kind, labels, says in rows] == expected


def test_the_text_has_every_metric_with_the_labels_of_the_table():
    """Nothing that the table does not have, and nothing of it is missing."""
    counted = counting.EventMetrics()
    counted.count([event(EventKind.MIGRATED, strategy="relaunch", seconds=2.0, blackout=0.5)])
    families = {
        family.name: family
        for family in text_string_to_metric_families(
            exposition(LISTING, 0.1, counted, LOAD, OWN).decode()
        )
    }

    assert set(families) == {name.removesuffix("_total") for name in METRICS}
    for name, metric in METRICS.items():
        family = families[name.removesuffix("_total")]
        assert (family.type, family.documentation) == (metric.kind, metric.meaning)
        for sample in family.samples:
            assert set(sample.labels) - {"le"} == set(metric.labels), sample


def test_the_values_of_a_listing():
    """Stale readings have no usage, and ended processes no metrics of their own."""
    found = values(exposition(LISTING, 0.25, load=LOAD))

    assert found["rosrm_journal_write_seconds",] == 0.01
    assert found["rosrm_up",] == 1.0
    assert found["rosrm_master_answer_seconds",] == 0.25
    assert found["rosrm_host_cordoned", "alpha"] == 1.0
    assert found["rosrm_resource_usage_ratio", "alpha", "memory"] == 0.4
    assert ("rosrm_resource_usage_ratio", "alpha", "cpu") not in found
    assert found["rosrm_processes", "queued"] == 2.0
    assert found["rosrm_processes", "failed"] == 0.0
    assert (found["rosrm_queue_length",], found["rosrm_queue_oldest_seconds",]) == (2.0, 8.0)
    assert found["rosrm_process_restarts", '<b a="1">\\', "alpha"] == 2.0
    assert ("rosrm_process_restarts", "old", "alpha") not in found
    assert ("rosrm_process_memory_bytes", "next", "alpha") not in found


def test_without_a_master_only_that_is_known():
    """The alert on a lost master needs a value."""
    assert values(exposition(None)) == {("rosrm_up",): 0.0}


def test_figures_that_have_not_arrived_have_no_value():
    """The master publishes its load once a second, and an older master has fewer figures."""
    assert not any(name == "rosrm_master_turn_seconds" for name, *_ in values(exposition(LISTING)))
    assert [value for _, _, value in sampling.of_load({"turn_s": 0.5, "strange": 1.0})] == [0.5]


def test_the_number_of_series_is_bounded():
    """Names of processes and of strategies come from users and plugins."""
    rows = [process(f"p{number:05}") for number in range(sampling.MOST_PROCESSES + 3)]
    found = values(exposition(Listing("lab", 1.0, 1, processes=rows)))
    assert sum(name == "rosrm_process_restarts" for name, *_ in found) == sampling.MOST_PROCESSES
    assert found["rosrm_processes_left_out",] == 3.0

    counted = counting.EventMetrics()
    for number in range(counting.MOST_STRATEGIES + 5):
        counted.count([event(EventKind.STAYED, strategy=f"s{number}")])
        counted.count([event(f"strange{number}")])
    found = values(exposition(None, 0.0, counted))
    assert found["rosrm_migrations_total", counting.OTHER, "stayed"] == 5.0
    assert found["rosrm_events_total", counting.OTHER] == counting.MOST_STRATEGIES + 5


def test_waits_and_starts_are_timed_by_events():
    """From the queue to a host, and from there until the process runs."""
    counted = counting.EventMetrics()
    counted.count([
        event(EventKind.SUBMITTED, wall=100.0), event(EventKind.ASSIGNED, wall=103.0),
        event(EventKind.READY, wall=103.5), event(EventKind.READY, wall=200.0),  # after a restart
        event(EventKind.SUBMITTED, "gone", 100.0), event(EventKind.CANCELLED, "gone", 101.0),
        event(EventKind.ASSIGNED, "gone", 150.0),
    ])  # fmt: skip
    found = values(exposition(None, 0.0, counted))

    waits = found["rosrm_queue_wait_seconds_count",], found["rosrm_queue_wait_seconds_sum",]
    starts = found["rosrm_start_seconds_count",], found["rosrm_start_seconds_sum",]
    assert (waits, starts) == ((1.0, 3.0), (1.0, 0.5))


def test_migrations_are_counted_by_strategy_and_outcome():
    """A migration that stayed has no duration, and not each has a known blackout."""
    counted = counting.EventMetrics()
    counted.count([
        event(EventKind.MIGRATED, strategy="relaunch", seconds=2.0, blackout=0.0),
        event(EventKind.MIGRATED, strategy="criu", seconds=3.0, blackout=0.25),
        event(EventKind.MIGRATED, strategy="criu", seconds=3.0),
        event(EventKind.STAYED, strategy="relaunch", seconds=9.0),
    ])  # fmt: skip
    found = values(exposition(None, 0.0, counted))

    assert found["rosrm_migrations_total", "relaunch", "moved"] == 1.0
    assert found["rosrm_migrations_total", "relaunch", "stayed"] == 1.0
    assert found["rosrm_migration_seconds_sum", "relaunch"] == 2.0
    assert found["rosrm_migration_seconds_count", "criu"] == 2.0
    assert found["rosrm_migration_blackout_seconds_count", "criu"] == 1.0
    assert found["rosrm_migration_blackout_seconds_sum", "criu"] == 0.25
    assert found["rosrm_events_total", "host_lost"] == 0.0


def expressions():
    """Return the expressions of the alert rules and of the dashboard, by where they are."""
    rules = yaml.safe_load(RULES.read_text())["groups"][0]["rules"]
    panels = json.loads(DASHBOARD.read_text())["panels"]
    return {
        **{one["alert"]: one["expr"] for one in rules},
        **{
            f"{one['title']} {target['refId']}": target["expr"]
            for one in panels for target in one["targets"]
        },
    }  # fmt: skip


@pytest.mark.parametrize("where", expressions())
def test_alerts_and_panels_use_metrics_and_labels_that_exist(where):
    """Names of metrics and labels, and kinds and states of the cluster."""
    expression = expressions()[where]
    used = [metric_of(name) for name in re.findall(r"\brosrm_\w+", expression)]
    assert used
    allowed = {"le", *(label for metric in used for label in metric.labels)}
    labels = re.findall(r"(\w+)=", re.sub(r"[<>=!]=", "", expression))
    for group in re.findall(r"by \((.*?)\)", expression):
        labels += group.split(", ")
    assert set(labels) <= allowed, expression
    kinds = re.findall(r'kind=~?"(.*?)"', expression)
    assert {kind for one in kinds for kind in one.split("|")} <= {one.value for one in EventKind}


@needs_promtool
def test_promtool_accepts_the_alert_rules():
    """The checker of Prometheus itself."""
    subprocess.run(["promtool", "check", "rules", RULES], check=True)


@needs_promtool
def test_promtool_accepts_the_metrics():
    """Names, units and types as Prometheus advises."""
    counted = counting.EventMetrics()
    counted.count([event(EventKind.MIGRATED, strategy="relaunch", seconds=2.0, blackout=0.5)])
    text = exposition(LISTING, 0.1, counted, LOAD, OWN)
    done = subprocess.run(
        ["promtool", "check", "metrics"], input=text, capture_output=True, check=False
    )
    assert (done.returncode, done.stderr) == (0, b"")
