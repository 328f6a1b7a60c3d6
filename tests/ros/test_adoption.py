"""A node that was started by hand becomes a process of a real cluster, and is not restarted."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import yaml

from rosrm.config.work import load_work
from tests.ros.clusters import NODE, Cluster, alive, host
from tests.ros.test_command_line import Terminal
from tests.waiting import wait_gone, wait_until

ROS_WORDS = ("--ros-args", "-r", "__node:=talker", "-r", "__ns:=/left", "-p", "rate:=10")


@pytest.fixture(scope="module")
def cluster(make_shared) -> Cluster:
    return make_shared(host("a"), host("b"))


@pytest.fixture
def rosrm(cluster: Cluster, tmp_path: Path) -> Terminal:
    return Terminal(cluster.domain, tmp_path)


@pytest.fixture
def by_hand(cluster: Cluster, tmp_path: Path) -> Iterator[Callable[..., subprocess.Popen]]:
    """Start programs without rosrm, in the domain of the cluster; they are killed at the end."""
    started = []

    def start(*words: str, **variables: str) -> subprocess.Popen:
        environment = {**os.environ, **cluster.ros.environment(), **variables}
        process = subprocess.Popen(
            words, env=environment, cwd=tmp_path, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE
        )
        started.append(process)
        return process

    yield start
    for process in started:
        process.kill()
        process.wait()
        process.stdout.close()


@pytest.fixture
def talker(by_hand, tmp_path: Path) -> subprocess.Popen:
    """A node that spins."""
    (tmp_path / "talker.py").write_text(NODE)
    process = by_hand(sys.executable, "talker.py", *ROS_WORDS, MY_TOKEN="s3cret")
    assert b"/left/talker" in process.stdout.readline()
    return process


def test_a_node_is_adopted_moved_and_cancelled(cluster, rosrm, talker) -> None:
    """The node runs on with its pid; the move starts its program with its names and parameters."""
    said = rosrm.run("adopt", str(talker.pid), "--name", "mover", "--host", "a")
    assert "1 running" in said
    row = cluster.process("mover")
    assert (row.state, row.pid, row.host) == ("running", talker.pid, "a")
    wait_until(lambda: cluster.process("mover").memory > 0, "its usage is measured")
    assert f"process {talker.pid} was adopted" in rosrm.run("logs", "mover")
    cluster.client.migrate("mover", "b")
    cluster.wait_for_event("migrated", process="mover")
    talker.wait()
    assert cluster.wait("mover", "running").host == "b"
    cluster.wait_for_log("mover", '"name": "/left/talker", "parameters": {"rate": 10}')
    cluster.cancel("mover")


def test_the_plan_shows_what_is_taken_and_changes_nothing(cluster, rosrm, talker, tmp_path) -> None:
    """The plan is a work file; of the other variables it has the names alone."""
    said = rosrm.run("adopt", str(talker.pid), "--name", "planned", "--host", "b", "--plan")
    (entry,) = yaml.safe_load(said)["processes"]
    assert entry == {
        "name": "planned", "command": [sys.executable, str(tmp_path / "talker.py")],
        "node_name": "talker", "namespace": "/left", "parameters": [{"rate": 10}], "ros": True,
        "working_directory": str(tmp_path), "migration": "relaunch",
    }  # fmt: skip
    assert "MY_TOKEN" in said
    assert "s3cret" not in said
    (spec,) = load_work(rosrm.file("plan.yaml", said))
    assert spec.node == "talker"
    assert "planned" not in [row.name for row in cluster.client.list(processes=True).processes]


def test_a_cancelled_process_ends(cluster, rosrm, by_hand) -> None:
    """Also one without ROS, and with a child."""
    process = by_hand("sh", "-c", "sleep 1000 & echo $!; wait")
    child = int(process.stdout.readline())
    rosrm.run("adopt", str(process.pid), "--name", "stopped", "--host", "a")
    cluster.client.cancel(["stopped"])
    process.wait()
    wait_gone(child)
    assert cluster.ended("stopped").state == "cancelled"


def test_an_adopted_process_survives_slave_and_master(cluster, rosrm, by_hand) -> None:
    """The supervisor has it, and the journal knows that nothing is left to be adopted."""
    process = by_hand("sleep", "1000")
    rosrm.run("adopt", str(process.pid), "--name", "kept", "--host", "a")
    cluster.start_slave_again("a")
    cluster.restart_master()
    row = cluster.wait("kept", "running")
    assert (row.pid, alive(process.pid)) == (process.pid, True)
    process.kill()
    row = cluster.wait("kept", "running", where=lambda one: one.pid not in (0, process.pid))
    assert row.restarts == 1
    cluster.cancel("kept")


# --- refusals ---------------------------------------------------------------------------------


def test_a_process_is_adopted_once(cluster, rosrm, by_hand) -> None:
    """The master knows the pids of its instances; the name is free again."""
    process = by_hand("sleep", "1000")
    rosrm.run("adopt", str(process.pid), "--name", "once", "--host", "a")
    said = rosrm.run("adopt", str(process.pid), "--name", "twice", "--host", "a", code=1)
    assert f"process {process.pid} of a is not adopted: it is the process once already" in said
    cluster.cancel("once")


def test_a_failed_adoption_says_why(cluster, rosrm, by_hand) -> None:
    """A child of an adopted process, of which only the supervisor knows; nothing is started."""
    process = by_hand("sh", "-c", "sleep 1000 & echo $!; wait")
    child = process.stdout.readline().decode().strip()
    rosrm.run("adopt", str(process.pid), "--name", "above", "--host", "a")
    said = rosrm.run("adopt", child, "--name", "below", "--host", "a", code=1)
    assert f"process {child} is not adopted: it belongs to the process above already" in said
    assert cluster.process("below").state == "failed"
    cluster.cancel("above")


@pytest.mark.parametrize(
    ("words", "code", "said"),
    [
        (["{pid}", "--name", "x"], 2, "--host: several hosts run on this machine: a or b"),
        (["{pid}", "--name", "x", "--host", "c"], 1, "no such host: 'c'"),
        (["{pid}", "--name", "a b", "--host", "a"], 2, "'a b' cannot be the name of a process"),
        (["1", "--name", "x", "--host", "a"], 1, "it is the first process of its machine"),
        (["0", "--name", "x", "--host", "a"], 1, "no process 0 runs on this machine"),
        (["{slave}", "--name", "x", "--host", "a"], 1, "it belongs to rosrm"),
        (["talker", "--name", "x"], 2, "Invalid value for 'PID'"),
        (["{pid}"], 2, "Missing option '--name'"),
    ],
)
def test_bad_input_is_refused(cluster, rosrm, by_hand, words, code, said) -> None:
    """One error each, and nothing is queued."""
    process = by_hand("sleep", "1000")
    names = {"pid": process.pid, "slave": cluster.slaves["a"].process.pid}
    error = rosrm.run("adopt", *(word.format(**names) for word in words), code=code)
    assert said in error
    assert process.poll() is None
    assert "x" not in [row.name for row in cluster.client.list(processes=True).processes]
