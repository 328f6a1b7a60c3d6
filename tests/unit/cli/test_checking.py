"""`rosrm config check`."""

from __future__ import annotations

import pytest

from rosrm.registry import Registry

from .test_starting import OURS


@pytest.fixture(autouse=True)
def registry(monkeypatch):
    monkeypatch.setattr(Registry, "discover", lambda: Registry.of(ours=OURS))


@pytest.fixture
def file(tmp_path):
    def write(text, name="f.yaml"):
        (tmp_path / name).write_text(text, encoding="utf-8")
        return tmp_path / name

    return write


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("scoring: {policy: weighted}", "ok, a cluster: scoring weighted, migration relaunch\n"),
        ("host: h1\nros: {domain: 1}", "ok, a host: h1, probes cpu\n"),
        ("processes: [{name: a, command: x, kind: job}]", "ok, work: 1 job and 0 services\n"),
        ("defaults: {kind: job}\nprocesses: [{name: a, command: x}]", "ok, work: 1 job and 0"),
    ],
)
def test_the_kind_of_a_right_file_is_known_by_its_keys(rosrm, file, text, said):
    result = rosrm("config", "check", file(text))
    assert result.code == 0
    assert f"f.yaml: {said}" in result.out


def test_a_file_that_may_be_either_wants_the_kind(rosrm, file):
    result = rosrm("config", "check", file("ros: {domain: 1}"))
    assert result.code == 2
    assert "its keys fit a cluster and a host file alike; say which with --kind" in result.err
    assert rosrm("config", "check", "--kind", "cluster", file("ros: {domain: 1}")).code == 0
    result = rosrm("config", "check", file(""))
    assert "it has no key of a cluster, host or work file" in result.err


def test_every_wrong_file_is_said_and_nothing_else_is_lost(rosrm, file):
    result = rosrm(
        "config",
        "check",
        file("scoring: {policy: wieghted}", "a.yaml"),
        file("host: h1", "b.yaml"),
        file("host: h1\nprobes: [lidar]", "c.yaml"),
        file("processes: [{name: a, command: x, migration: criu}]", "d.yaml"),
    )
    assert result.code == 2
    assert "b.yaml: ok" in result.out
    assert "a.yaml:1:11: unknown scoring policy 'wieghted'; did you mean 'weighted'?" in result.err
    assert "c.yaml:2:10: unknown probe 'lidar'. Installed: cpu." in result.err
    assert "d.yaml:1:46: unknown migration strategy 'criu'. Installed: relaunch." in result.err


@pytest.mark.parametrize(
    ("text", "warning"),
    [
        (
            "processes: [{name: a, command: x, needs: {cpus: 1}}]",
            "a: needs: no probe is named 'cpus'; did you mean 'cpu'?",
        ),
        (
            """
            defaults: {package: p, executable: e}
            processes: [{name: a}, {name: b, arguments: [--ros-args, -r, '__node:=a']}]
            """,
            "a and b put the node /a into the ROS graph; give each node a name of its own",
        ),
    ],
)
def test_what_may_be_a_mistake_is_a_warning(rosrm, tmp_path, text, warning):
    file = tmp_path / "w.yaml"
    file.write_text(text, encoding="utf-8")
    result = rosrm("config", "check", file)
    assert result.code == 0
    assert result.err == f"{file}: warning: {warning}\n"


def test_a_resource_that_no_probe_here_measures_is_no_mistake(rosrm, tmp_path):
    file = tmp_path / "w.yaml"
    file.write_text("processes: [{name: a, command: x, needs: {gpu_memory: 1}}]", encoding="utf-8")
    assert rosrm("config", "check", file).err == ""
