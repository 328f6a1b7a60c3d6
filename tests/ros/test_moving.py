"""Moves for more than limits, and reloads, with real slaves and processes."""

from __future__ import annotations

import signal

import pytest

from rosrm.errors import Refused
from rosrm.model.values import MigrationPolicy, ReschedulePolicy
from tests.ros.clusters import MIB, host, job, python, service

RELAUNCH = MigrationPolicy("relaunch")


def sized(name: str, memory: float, **fields):
    """Return a service that declares its need of memory in MiB."""
    return service(name, needs={"memory": memory * MIB, "cpu": 0.01}, **fields)


def test_a_process_of_a_lower_priority_makes_room(make_cluster) -> None:
    """The process moves to another host; `explain` shows the move in the history of both."""
    cluster = make_cluster(host("a", memory=1000 * MIB), host("b", memory=500 * MIB))
    cluster.client.set_host_state("b", "cordon")
    cluster.submit(sized("low", 300, migration=RELAUNCH))
    cluster.wait("low", "running", host="a")
    cluster.client.set_host_state("b", "uncordon")
    cluster.submit(sized("high", 600, priority=5))
    cluster.wait("high", "running", host="a")
    cluster.wait("low", "running", host="b")
    for name in ("low", "high"):
        said = [one["message"] for one in cluster.client.explain(name)["history"]]
        assert (
            "low makes room on a for high, which has a higher priority (5 over 0): it moves to b"
        ) in said


def test_rebalance_does_what_its_plan_has_said(make_cluster) -> None:
    """The plan moves nothing."""
    cluster = make_cluster(host("a", memory=1000 * MIB), host("b", memory=1000 * MIB))
    cluster.client.set_host_state("b", "cordon")
    names = ("p", "q")
    cluster.submit(*(sized(name, 300, migration=RELAUNCH) for name in names))
    for name in names:
        cluster.wait(name, "running", host="a")
    cluster.client.set_host_state("b", "uncordon")
    plan = cluster.client.rebalance(plan_only=True)
    assert "move p from a (" in plan
    assert {row.host for row in cluster.client.list(processes=True).processes} == {"a"}
    assert "move p from a (" in cluster.client.rebalance()
    cluster.wait("p", "running", host="b")
    cluster.wait_for_event("migrated", process="p")


def test_a_process_that_fails_on_one_host_runs_on_another(make_cluster, tmp_path) -> None:
    """The first host is broken for it."""
    cluster = make_cluster(host("a"), host("b"))
    broken = f"import os, time\ntry:\n os.mkdir({str(tmp_path / 'x')!r})\nexcept OSError:\n "
    cluster.submit(
        python(
            "p", f"{broken}time.sleep(1000)\nraise SystemExit(3)",
            reschedule=ReschedulePolicy(attempts=1),
        )
    )  # fmt: skip
    event = cluster.wait_for_event("queued", "attempt 1 of 1 on another host", process="p")
    row = cluster.wait("p", "running")
    assert row.host != event.host
    reasons = {
        one["name"]: one["reason"] for one in cluster.client.explain("p")["decision"]["hosts"]
    }
    assert "p failed there: " in reasons[event.host]


def test_a_job_that_runs_longer_than_its_time_limit_has_failed(make_cluster) -> None:
    """Its process is stopped."""
    cluster = make_cluster(host("a"))
    (row,) = cluster.run(job("p", "sleep", "1000", time_limit=1.0))
    assert (row.state, row.reason) == ("failed", "it ran longer than its time limit of 1 s")


@pytest.fixture
def reloadable(make_cluster, tmp_path):
    """Return a cluster whose parts read files; `ros` and `state` of the tests are not in them."""
    (tmp_path / "c.yaml").write_text("name: rosrm\n")
    (tmp_path / "h.yaml").write_text(HOST)
    cluster = make_cluster(host("a"), started=False)
    cluster.files = {"master": tmp_path / "c.yaml", "a": tmp_path / "h.yaml"}
    cluster.__enter__()
    cluster.submit(service("p", required_labels={"arm": "yes"}))
    cluster.wait("p", "set_aside")
    return cluster


HOST = """\
host: a
scope: slice
budget: {memory: 2GiB, cpu: 16}
probes: [memory, cpu]
"""


def test_a_reload_changes_labels_and_limits_without_a_restart(reloadable, tmp_path) -> None:
    """Settings of the tests that are not in the files need a restart, and are named."""
    pid = reloadable.slaves["a"].process.pid
    (tmp_path / "h.yaml").write_text(f"{HOST}labels: {{arm: yes}}\nlimits: {{cpu: 0.5}}\n")
    (tmp_path / "c.yaml").write_text("queue: {backfill: true}\n")
    master, slave = reloadable.client.reload().splitlines()
    assert "queue" in master.partition(";")[0]
    assert "; ros, state" in master
    assert master.endswith(" need a restart, and stay as before")
    assert slave.startswith("a: reloaded labels and limits; ")
    reloadable.wait("p", "running", host="a")
    (row,) = reloadable.client.list(hosts=True).hosts
    limits = {one.name: one.limit for one in row.resources}
    assert (row.description.labels, limits["cpu"]) == ({"arm": "yes"}, 0.5)
    assert reloadable.slaves["a"].process.pid == pid


def test_a_broken_file_changes_nothing(reloadable, tmp_path) -> None:
    """The answer says file, place and what is allowed."""
    (tmp_path / "h.yaml").write_text(f"{HOST}limits: {{cpu: 1.5}}\nlabels: {{arm: yes}}\n")
    with pytest.raises(Refused) as refusal:
        reloadable.client.reload()
    assert "a: not reloaded: " in str(refusal.value)
    assert "h.yaml:5:" in str(refusal.value)
    assert "within 0..1" in str(refusal.value)
    (tmp_path / "c.yaml").write_text("queue: {backfil: true}\n")
    with pytest.raises(Refused) as refusal:
        reloadable.client.reload()
    assert "c.yaml:1:9: unknown key 'backfil' in queue; did you mean 'backfill'?" in str(
        refusal.value
    )
    assert "no slave has read its file" in str(refusal.value)
    (row,) = reloadable.client.list(hosts=True).hosts
    assert row.description.labels == {}
    assert {one.name: one.limit for one in row.resources}["cpu"] == 0.9


def test_sighup_without_a_terminal_reloads(reloadable, tmp_path) -> None:
    """As `systemctl reload` of a service of systemd; the signal ends neither part."""
    (tmp_path / "h.yaml").write_text(f"{HOST}labels: {{arm: yes}}\n")
    (tmp_path / "c.yaml").write_text("queue: {backfill: true}\n")
    for part in (reloadable.master, reloadable.slaves["a"]):
        part.end(signal.SIGHUP)
    reloadable.wait_for_event("settings_reloaded", "queue")
    reloadable.wait_for_event("host_changed", "a has other labels: arm=yes")
    reloadable.wait("p", "running", host="a")
