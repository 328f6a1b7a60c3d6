"""Modes on a real cluster: what both share runs on, and conditions begin a switch."""

from __future__ import annotations

import signal
import sys
from pathlib import Path

import pytest
import yaml

from rosrm.client.client import Client
from rosrm.client.waiting import wait_for_mode
from rosrm.config.modes import load_modes
from rosrm.config.settings import LivenessSettings
from rosrm.errors import Refused
from rosrm.model.modes import ModeRow
from tests.ros.clusters import MIB, STEADY, Cluster, host
from tests.waiting import PATIENCE

STOP = {"interrupt_grace": 0.5, "terminate_grace": 0.5}
#: Takes memory once a file exists.
GROWS = """
import os, sys, time
while not os.path.exists(sys.argv[1]): time.sleep(0.02)
taken = b"1" * int(sys.argv[2])
time.sleep(1000)
"""


def work(directory: Path, app: str, *names: str, **fields: object) -> str:
    """Write the work file of an application, and return its name."""
    shared = {"command": ["sleep", "1000"], "stop": STOP, **fields}
    parts = [{"name": name, **shared} for name in names]
    content = {"app": app, "rollout": {"healthy_for": 0.2}, "processes": parts}
    (directory / f"{app}.yaml").write_text(yaml.safe_dump(content), encoding="utf-8")
    return f"{app}.yaml"


def load(cluster: Cluster, modes: dict[str, dict[str, object]]) -> str:
    path = cluster.directory / "modes.yaml"
    path.write_text(yaml.safe_dump({"modes": modes}, sort_keys=False), encoding="utf-8")
    return cluster.client.load_modes(load_modes(path))


def reach(cluster: Cluster) -> dict[str, ModeRow]:
    """Wait until no switch is under way; return the modes by name."""
    rows = wait_for_mode(
        cluster.client, timeout=PATIENCE, on_change=lambda _: None, notify=lambda _: None
    )
    return {row.name: row for row in rows}


def test_a_switch_keeps_the_pids_of_what_both_modes_share(make_cluster) -> None:
    """Also where the master is killed in the middle, and past a mode that cannot be reached."""
    cluster = make_cluster(host("a"))
    nav = work(cluster.directory, "navigation", "planner", "driver")
    mapping = work(cluster.directory, "mapping", "mapper")
    dock = work(cluster.directory, "docking", "charger")
    never = work(cluster.directory, "never", "huge", needs={"memory": "1TB"})
    loaded = load(
        cluster,
        {
            "exploring": {"applications": [nav, mapping]},
            "docked": {"applications": [nav, dock], "limits": {"memory": 0.5}},
            "never": {"applications": [never]},
        },
    )
    assert loaded == "3 modes loaded: exploring, docked and never"
    cluster.client.switch_mode("exploring")
    assert reach(cluster)["exploring"].state == "in force"
    pids = {name: cluster.wait(name, "running").pid for name in ("planner", "driver")}

    with pytest.raises(Refused, match="the mode never cannot be reached: huge would wait: "):
        cluster.client.switch_mode("never")
    planned = cluster.client.switch_mode("docked", plan_only=True)
    assert {one.process: one.action.value for one in planned.actions} == {
        "charger": "start", "mapper": "stop",
    }  # fmt: skip

    cluster.client.switch_mode("docked")
    cluster.restart_master()
    assert reach(cluster)["docked"].state == "in force"
    assert cluster.wait("charger", "running").pid
    assert cluster.wait("mapper", "cancelled")
    assert {name: cluster.process(name).pid for name in pids} == pids
    cluster.wait_until(  # the restarted master has no limit before the first reading
        "the memory limit of the mode",
        lambda view: {one.name: one.limit for one in view.hosts[0].resources}["memory"] == 0.5,
    )


def test_a_mode_that_is_loaded_with_other_contents_is_other_work(make_cluster) -> None:
    """A kept plan then holds no more, even if no action of it differs."""
    cluster = make_cluster(host("a"))
    client = Client(connection=cluster.client)

    def work_of_a_plan(seconds: str) -> str:
        dock = work(cluster.directory, "docking", "charger", command=["sleep", seconds])
        load(cluster, {"docked": {"applications": [dock]}})
        planned = client.switch_mode("docked", plan_only=True)
        assert [one.process for one in planned.actions] == ["charger"]
        return planned.work

    first = work_of_a_plan("1000")
    assert work_of_a_plan("1000") == first
    assert work_of_a_plan("2000") != first


def test_a_lost_host_puts_a_mode_into_force(make_cluster) -> None:
    """The operator has done nothing but load the modes."""
    cluster = make_cluster(
        host("a", labels={"site": "a"}),
        host("b"),
        liveness=LivenessSettings(suspect=1.0, lease=2.0),
    )
    nav = work(cluster.directory, "navigation", "planner", labels={"required": {"site": "a"}})
    both = work(cluster.directory, "watching", "watcher", labels={"required": {"site": "a"}})
    load(
        cluster,
        {
            "usual": {"applications": [nav]},
            "degraded": {"applications": [nav, both], "when": {"host_lost": "b"}},
        },
    )
    cluster.client.switch_mode("usual")
    assert reach(cluster)["usual"].state == "in force"
    pid = cluster.wait("planner", "running").pid
    cluster.end(cluster.slaves["b"], signal.SIGKILL)
    cluster.wait_for_event("mode_begins", "switches to the mode degraded: b is lost")
    assert reach(cluster)["degraded"].state == "in force"
    assert cluster.wait("watcher", "running").host == "a"
    assert cluster.process("planner").pid == pid


def test_a_host_over_its_limit_puts_a_mode_into_force(make_cluster) -> None:
    """A slave's reading begins the condition, and the switch follows after the time of the mode."""
    lasts = 1.5  # seconds
    limits = {"memory": 0.5, "cpu": 1.0}
    cluster = make_cluster(host("a", memory=400 * MIB, limits=limits), liveness=STEADY)
    go = cluster.directory / "go"
    grows = [sys.executable, "-ISc", GROWS, str(go), str(250 * MIB)]
    nav = work(cluster.directory, "navigation", "planner")
    mapping = work(cluster.directory, "mapping", "mapper", command=grows)
    when = {"over_limit": "memory", "for": f"{lasts}s"}
    load(
        cluster,
        {
            "usual": {"applications": [nav, mapping]},
            "degraded": {"applications": [nav], "when": when},
        },
    )
    cluster.client.switch_mode("usual")
    assert reach(cluster)["usual"].state == "in force"
    pid = cluster.wait("planner", "running").pid
    assert cluster.events("over_limit") == []
    go.touch()
    over = cluster.wait_for_event("over_limit", "memory", host="a")
    begun = cluster.wait_for_event("mode_begins", "degraded: a host is over its limit of memory")
    assert begun.elapsed - over.elapsed >= lasts - 0.05
    assert reach(cluster)["degraded"].state == "in force"
    assert cluster.wait("mapper", "cancelled")
    cluster.wait_for_event("under_limit", host="a")
    assert reach(cluster)["degraded"].state == "in force"
    assert cluster.process("planner").pid == pid
