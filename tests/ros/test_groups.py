"""Groups and gangs on real slaves: a file that starts completely and ends completely."""

from __future__ import annotations

import textwrap
from pathlib import Path

import pytest

from rosrm.config.settings import ProcessDefaults
from rosrm.config.work import load_work
from rosrm.errors import Refused
from tests.ros.clusters import MIB, STEADY, host, service

WORK = """
    defaults:
      stop: {interrupt_grace: 500ms, terminate_grace: 500ms}
      together: demo
    group: {name: demo, ends_with: rviz}
    processes:
      - name: rviz
        kind: job
        command: [sh, -c, "until [ -e closed ]; do sleep 0.1; done"]
        working_directory: .
      - name: "lidar_{i}"
        foreach: {i: "range(0, 2)"}
        command: sleep 1000
        needs: {memory: 600MiB}
"""


def test_a_file_starts_as_a_gang_and_ends_as_a_group(make_cluster, tmp_path: Path) -> None:
    """Nothing starts before both hosts have room, and the end of one process ends the rest."""
    cluster = make_cluster(
        host("a", memory=1024 * MIB), host("b", memory=1024 * MIB), liveness=STEADY,
        defaults=ProcessDefaults(needs={"memory": MIB}),
    )  # fmt: skip
    cluster.submit(service("other", needs={"memory": 600 * MIB}))
    cluster.wait("other", "running")
    file = tmp_path / "work.yaml"
    file.write_text(textwrap.dedent(WORK), encoding="utf-8")
    demo = load_work(file)
    cluster.submit(*demo)
    cluster.wait_for_event("waits", "no room for all 3 of the gang demo at once: lidar_")
    assert cluster.events("assigned", process="rviz") == []
    with pytest.raises(Refused, match="a gang demo waits already"):
        cluster.submit(service("late", together="demo"))

    cluster.cancel("other")
    where = {cluster.wait(f"lidar_{i}", "running").host for i in range(2)}
    assert where == {"a", "b"}
    cluster.wait("rviz", "running")

    (tmp_path / "closed").touch()
    for name in ("lidar_0", "lidar_1"):
        row = cluster.ended(name)
        assert (row.state, row.reason) == ("cancelled", "rviz of the group demo finished")
    assert cluster.ended("rviz").state == "finished"
