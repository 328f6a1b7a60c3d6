"""Applications on real slaves: their order, gangs, groups and arrays, and the way back."""

from __future__ import annotations

from typing import Any

import pytest
import yaml

from rosrm.client.waiting import wait_for_applications
from rosrm.config.work import load_application
from rosrm.model.applications import Action, ApplicationRow, Target
from rosrm.ros import convert
from tests.ros.clusters import MIB, Cluster, host
from tests.waiting import PATIENCE, wait_until

SLEEP = ["sleep", "1000"]


@pytest.fixture(scope="module")
def cluster(make_shared) -> Cluster:
    """A cluster for all tests of the module; each has an application of its own."""
    return make_shared(host("a", memory=1024 * MIB), host("b", memory=1024 * MIB))


def target(cluster: Cluster, app: str, *processes: dict[str, Any], **fields: Any) -> Target:
    """Return the application of a work file with these processes."""
    stop = {"interrupt_grace": 0.5, "terminate_grace": 0.5}
    parts = [{"command": SLEEP, "stop": stop, **one} for one in processes]
    content = {"app": app, "rollout": {"healthy_for": 0.2}, "processes": parts, **fields}
    path = cluster.directory / f"{app}.yaml"
    path.write_text(yaml.safe_dump(content), encoding="utf-8")
    return load_application(path)


def reach(cluster: Cluster, app: str) -> ApplicationRow:
    """Wait until nothing of an application changes any more; return its row."""
    (row,) = wait_for_applications(
        cluster.client, [app], timeout=PATIENCE, on_change=lambda _: None, notify=lambda _: None
    )
    return row


def apply(cluster: Cluster, app: str, *processes: dict[str, Any], **fields: Any) -> dict[str, str]:
    """Apply an application, and wait for its end; return the actions by process."""
    result = cluster.client.apply([target(cluster, app, *processes, **fields)])
    reach(cluster, app)
    return {one.process: one.action.value for one in result.actions}


def cancel(cluster: Cluster, app: str) -> None:
    cluster.client.apply([Target(app)])
    assert reach(cluster, app).state == "cancelled"


def test_only_what_differs_is_touched_and_a_revert_brings_back_the_rest(cluster: Cluster) -> None:
    """Each change replaces, stops or starts one process, and the others keep their pid."""
    keep, old, gone = {"name": "keep"}, {"name": "swap"}, {"name": "gone"}
    assert set(apply(cluster, "swaps", keep, old, gone).values()) == {"start"}
    pids = {name: cluster.wait(name, "running").pid for name in ("keep", "swap", "gone")}
    assert apply(cluster, "swaps", keep, old, gone) == {}

    new = {"name": "swap", "environment": {"VERSION": "2"}}
    assert apply(cluster, "swaps", keep, new) == {"swap": "replace", "gone": "stop"}
    assert cluster.wait("swap", "running").pid != pids["swap"]
    assert cluster.process("gone").state == "cancelled"

    cluster.client.apply([Target("swaps", version=1)])
    row = reach(cluster, "swaps")
    assert (row.state, row.version, row.running) == ("running", 3, 3)
    assert cluster.process("keep").pid == pids["keep"]
    cancel(cluster, "swaps")


def test_a_version_that_does_not_run_is_given_up(cluster: Cluster) -> None:
    """The processes that were replaced before get their old program back."""
    apply(cluster, "fails", {"name": "first"}, {"name": "second"})
    broken = {"name": "second", "command": ["false"]}
    apply(cluster, "fails", {"name": "first", "environment": {"VERSION": "2"}}, broken)
    row = reach(cluster, "fails")
    assert (row.state, row.version, row.running) == ("running", 1, 2)
    assert row.returned_from is not None
    assert row.returned_from.given_up.startswith("second: ")
    cancel(cluster, "fails")


def test_processes_start_in_their_order_and_stop_in_the_reverse_one(cluster: Cluster) -> None:
    """The order of the file does not matter."""
    viewer = {"name": "viewer", "after": {"camera": "ready"}}
    camera = {"name": "camera", "after": {"calibrate": "finished"}}
    calibrate = {"name": "calibrate", "kind": "job", "command": ["true"]}
    apply(cluster, "ordered", viewer, camera, calibrate)
    assert reach(cluster, "ordered").running == 3
    cancel(cluster, "ordered")
    sequence = {(one.process, one.kind): one.sequence for one in cluster.events()}
    assert sequence["calibrate", "finished"] < sequence["camera", "assigned"]
    assert sequence["camera", "assigned"] < sequence["viewer", "assigned"]
    assert sequence["viewer", "cancelled"] < sequence["camera", "cancelled"]


def test_a_gang_waits_as_a_whole(cluster: Cluster) -> None:
    """The plan says so, and both processes start once there is room for both."""
    large = {"needs": {"memory": "600MiB"}}
    apply(cluster, "large", {"name": "other", **large})
    pair = [{"name": name, "together": "pair", **large} for name in ("left", "right")]
    wanted = target(cluster, "pair", *pair)
    planned = cluster.client.apply([wanted], plan_only=True)
    assert [one.action for one in planned.actions] == [Action.START, Action.START]
    assert all("no room for all 2 of the gang pair" in one.waits for one in planned.actions)

    cluster.client.apply([wanted])
    cluster.wait_for_event("waits", "no room for all 2 of the gang pair")
    assert cluster.events("assigned", process="left") == []
    assert cluster.events("assigned", process="right") == []
    cancel(cluster, "large")
    assert reach(cluster, "pair").state == "running"
    assert {cluster.process(name).host for name in ("left", "right")} == {"a", "b"}
    cancel(cluster, "pair")


def test_a_group_ends_as_a_whole_until_the_next_apply(cluster: Cluster) -> None:
    """The end of the viewer ends the rest, which the same file starts again."""
    flag = cluster.directory / "closed"
    script = f"until [ -e {flag} ]; do sleep 0.05; done"
    viewer = {"name": "rviz", "kind": "job", "command": ["sh", "-c", script]}
    group = {"group": {"name": "demo", "ends_with": "rviz"}}
    apply(cluster, "grouped", viewer, {"name": "lidar"}, **group)
    flag.touch()
    assert cluster.ended("rviz").state == "finished"
    row = cluster.ended("lidar")
    assert (row.state, row.reason) == ("cancelled", "rviz of the group demo finished")
    assert apply(cluster, "grouped", viewer, {"name": "lidar"}, **group) == {"lidar": "start"}
    cancel(cluster, "grouped")


def test_an_array_runs_once_however_often_it_is_applied(cluster: Cluster) -> None:
    """Finished jobs stay finished; another program repeats all of them."""
    log = cluster.directory / "rendered"

    def render(word: str) -> dict[str, Any]:
        script = f"echo {word}$ROSRM_ARRAY_INDEX >> {log}"
        command = ["sh", "-c", script]
        return {"name": "render", "kind": "job", "array": "1-3", "parallel": 1, "command": command}

    def lines() -> list[str]:
        return log.read_text(encoding="utf-8").split() if log.exists() else []

    apply(cluster, "film", render("one"))
    wait_until(lambda: len(lines()) == 3, "three jobs have run", pause=cluster.client.spin)
    for index in (1, 2, 3):
        cluster.ended(f"render-{index}")
    assert apply(cluster, "film", render("one")) == {}
    assert lines() == ["one1", "one2", "one3"]
    again = apply(cluster, "film", render("two"))
    assert again == {f"render-{index}": "start" for index in (1, 2, 3)}
    wait_until(lambda: len(lines()) == 6, "they have run again", pause=cluster.client.spin)
    assert lines()[3:] == ["two1", "two2", "two3"]
    cancel(cluster, "film")


def test_an_apply_of_an_unchanged_file_leaves_schedules_alone(cluster: Cluster) -> None:
    """Runs follow at their times, and the apply starts none."""
    jobs = [
        {"name": name, "kind": "job", "every": every, "command": ["true"]}
        for name, every in (("often", "1s"), ("hourly", "1h"))
    ]

    def runs(name: str) -> int:
        return len(cluster.events("finished", process=name))

    assert apply(cluster, "clock", *jobs) == {"often": "start", "hourly": "start"}
    wait_until(lambda: runs("often") >= 2, "two runs of often", pause=cluster.client.spin)
    following = cluster.wait("hourly", "scheduled").next_run
    before = runs("often")
    assert apply(cluster, "clock", *jobs) == {}
    wait_until(lambda: runs("often") >= before + 2, "two more runs", pause=cluster.client.spin)
    hourly = cluster.wait("hourly", "scheduled")
    assert (runs("hourly"), hourly.next_run) == (1, following)
    cancel(cluster, "clock")


def test_a_client_sends_known_processes_only_once(cluster: Cluster, monkeypatch) -> None:
    """Their digest suffices for the next requests; a master that was restarted asks for them."""
    sent: list[str] = []
    whole = convert.spec_to_msg
    monkeypatch.setattr(convert, "spec_to_msg", lambda spec: sent.append(spec.name) or whole(spec))
    wanted = target(cluster, "known", {"name": "known"})
    cluster.client.apply([wanted])
    cluster.client.apply([wanted])
    assert reach(cluster, "known").state == "running"
    assert sent == ["known"]
    pid = cluster.process("known").pid
    cluster.restart_master()
    cluster.wait_for_hosts()
    assert cluster.client.apply([wanted]).message == "known is at version 1: nothing changes"
    assert sent == ["known"] * 2
    assert cluster.wait("known", "running").pid == pid
    cancel(cluster, "known")
