"""`rosrm alerts run` and `rosrm events --mcap` on a real cluster, with a real receiver."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys

import pytest
import yaml
from mcap.reader import make_reader

from tests.ros.clusters import STEADY, Cluster, host, job
from tests.waiting import PATIENCE
from tests.webhook_kit import Receiver

ALERTS = {
    "sinks": {"chat": {"use": "webhook"}},
    "events": [{"kinds": ["failed"], "to": "chat"}],
    "alerts": {
        "done": {"when": {"state": "finished", "process": "warm*"}, "to": "chat"},
        "silent": {"when": {"no_master": True}, "to": "chat", "level": "ERROR"},
    },
}


@contextlib.contextmanager
def rosrm(cluster: Cluster, *words: str):
    """Start a command, and kill it at the end if it still runs."""
    environment = {**os.environ, "ROS_DOMAIN_ID": str(cluster.domain)}
    argv = [sys.executable, "-m", "rosrm.cli", *words]
    log = (cluster.directory / "alerts.log").open("ab")
    with log, subprocess.Popen(argv, env=environment, stdout=log, stderr=log) as process:
        try:
            yield process
        finally:
            process.kill()


@pytest.fixture
def cluster(make_cluster) -> Cluster:
    return make_cluster(host("a"), liveness=STEADY)


def fail(cluster: Cluster, name: str) -> None:
    cluster.run(job(name, "sh", "-c", "exit 3"))


def test_alerts_reach_the_receiver_over_kills_of_both_sides(cluster) -> None:
    """A killed master is an alert; a killed `rosrm alerts run` continues where it was."""
    with Receiver() as receiver:
        ALERTS["sinks"]["chat"]["url"] = receiver.url
        file = cluster.directory / "alerts.yaml"
        file.write_text(yaml.safe_dump(ALERTS))
        words = ("alerts", "run", str(file), "--state", str(cluster.directory / "alerts"))
        with rosrm(cluster, *words) as process:
            cluster.run(job("warm-up", "true"))
            receiver.wait_for(kind="alert_begins", process="warm-up")
            fail(cluster, "first")
            receiver.wait_for(kind="failed", process="first")
            process.kill()
            process.wait(PATIENCE)

        fail(cluster, "second")
        with rosrm(cluster, *words) as process:
            receiver.wait_for(kind="failed", process="second")
            cluster.end(cluster.master, signal.SIGKILL)
            receiver.wait_for(kind="alert_begins", alert="silent", level="ERROR")
            cluster.reconnect()
            cluster.start_master()
            receiver.wait_for(kind="alert_ends", alert="silent")
            process.send_signal(signal.SIGTERM)
            assert process.wait(PATIENCE) == 0

    # A notice may arrive twice if the command is killed during its delivery, with the same id.
    by_id = {one["id"]: one for one in receiver.notices}
    assert [(one["kind"], one["alert"] or one["process"]) for one in by_id.values()] == [
        ("alert_begins", "done"),
        ("failed", "first"),
        ("failed", "second"),
        ("alert_begins", "silent"),
        ("alert_ends", "silent"),
    ]


def test_events_go_into_a_file_for_foxglove(cluster) -> None:
    """Each event is a message of the schema foxglove.Log at its own time."""
    fail(cluster, "broken")
    file = cluster.directory / "events.mcap"

    with rosrm(cluster, "events", "--mcap", str(file)) as process:
        assert process.wait(PATIENCE) == 0

    events = {event.sequence: event for event in cluster.events()}
    with file.open("rb") as stream:
        messages = list(make_reader(stream).iter_messages())
    forms = [json.loads(message.data) for _, _, message in messages]
    assert [form["kind"] for form in forms] == [event.kind for event in events.values()]
    assert [message.log_time for _, _, message in messages] == [
        round(event.wall_time * 1e9) for event in events.values()
    ]
    (failed,) = [form for form in forms if form["kind"] == "failed"]
    assert (failed["process"], failed["level"]) == ("broken", 4)
