"""Processes on real hosts: forms of start, readiness, restarts, logs and ends."""

from __future__ import annotations

import json
import os
import stat
import subprocess
import sys
from pathlib import Path

import pytest

from rosrm.config.settings import LogSettings
from rosrm.errors import Refused
from rosrm.model.values import (
    Kind,
    ParameterSource,
    ProcessSpec,
    Readiness,
)
from tests.ros.clusters import CALM, NODE, QUICK, alive, host, job, node, python, service
from tests.waiting import wait_gone, wait_until


@pytest.fixture(scope="module")
def cluster(make_shared):
    small_logs = LogSettings(max_bytes=20_000, keep=2)
    return make_shared(
        host("h0", logs=small_logs), host("h1", logs=small_logs, labels={"place": "lab"})
    )


@pytest.fixture
def ament_prefix(tmp_path):
    """Return the prefix of a ROS package with a Python executable, as colcon installs it."""
    marker = tmp_path / "share/ament_index/resource_index/packages/fake_package"
    marker.parent.mkdir(parents=True)
    marker.write_text("")
    program = tmp_path / "lib/fake_package/talker"
    program.parent.mkdir(parents=True)
    program.write_text(f"#!{sys.executable}\n{NODE}")
    program.chmod(program.stat().st_mode | stat.S_IXUSR)
    return tmp_path


# --- forms ------------------------------------------------------------------------------------


def test_a_command_runs_to_its_end(cluster) -> None:
    """A job that exits with 0 has finished, and its events are recorded."""
    row = cluster.run(job("echo", "echo", "hello there"))[0]
    assert (row.state, row.exit_code) == ("finished", 0)
    assert cluster.log("echo") == "hello there\n"
    kinds = cluster.kinds("echo")
    assert kinds[0] == "submitted"
    assert kinds.index("assigned") < kinds.index("finished")


def test_a_service_runs_until_it_is_cancelled(cluster) -> None:
    """A service has a pid, shows its usage, and is gone after a cancellation."""
    cluster.submit(service("sleeper"))
    row = cluster.wait("sleeper", "running")
    assert alive(row.pid)
    row = cluster.wait("sleeper", "running", where=lambda row: row.memory > 0)
    assert row.memory < 50 * 2**20
    cluster.cancel("sleeper")
    assert not alive(row.pid)
    assert cluster.process("sleeper").state == "cancelled"


def test_a_program_that_is_not_there(cluster) -> None:
    """All hosts are tried; the final reason names them, and the missing program.

    Only the explanation has the PATH.
    """
    row = cluster.run(job("nothing", "no-such-program"))[0]
    assert row.state == "failed"
    assert row.reason.endswith(": program 'no-such-program' is not on the PATH")
    assert {"h0 and h1", "h1 and h0"} & set(row.reason.split(": "))
    history = cluster.client.explain("nothing")["history"]
    assert sum("on the PATH; the PATH is /" in entry["message"] for entry in history) == 2


# --- ROS nodes --------------------------------------------------------------------------------


def said(cluster, name: str) -> dict:
    log = cluster.wait_for_log(name, "}\n")
    # Fast DDS may have printed a message about its shared memory before.
    return json.loads(next(line for line in log.splitlines() if line.startswith("{")))


def test_name_parameters_and_remappings_reach_the_node(cluster, ament_prefix) -> None:
    """A package's executable is found in the ament index, and gets everything in the spec."""
    cluster.submit(
        ProcessSpec(
            "talker", package="fake_package", executable="talker", ros=True, namespace="/robot",
            parameters={"rate": 2.5, "words": ["a", "b"], "nested.flag": True, "text": "10"},
            remappings={"chatter": "/elsewhere"},
            environment={"AMENT_PREFIX_PATH": str(ament_prefix)}, stop=CALM,
        )
    )  # fmt: skip
    cluster.wait("talker", "running")
    assert said(cluster, "talker") == {
        "name": "/robot/talker",
        "parameters": {"rate": 2.5, "words": ["a", "b"], "nested.flag": True, "text": "10"},
        "topic": "/elsewhere",
    }
    cluster.cancel("talker")


def test_two_nodes_of_one_name_in_two_namespaces(cluster, tmp_path) -> None:
    """Each process has a name of its own, and its node the parameters of its section, in order."""
    file = tmp_path / "params.yaml"
    file.write_text(
        "/**: {ros__parameters: {rate: 1.0, text: file}}\n"
        "/left/talker: {ros__parameters: {rate: 2.5}}\n"
    )
    sources = (
        ParameterSource(parameters={"words": ["a"], "nested.flag": True, "text": "x"}),
        ParameterSource(str(file)), ParameterSource(nodes="/right/*", parameters={"text": "last"}),
    )  # fmt: skip
    for side in ("left", "right"):
        cluster.submit(
            node(
                f"{side}.talker", node_name="talker", namespace=f"/{side}", prefix=("nice",),
                parameter_sources=sources,
            )
        )  # fmt: skip
    found = {}
    for side in ("left", "right"):
        cluster.wait(f"{side}.talker", "running")
        found[side] = said(cluster, f"{side}.talker")
        cluster.cancel(f"{side}.talker")
    given = {side: (it["name"], it["parameters"]) for side, it in found.items()}
    common = {"words": ["a"], "nested.flag": True}
    assert given == {
        "left": ("/left/talker", {**common, "rate": 2.5, "text": "file"}),
        "right": ("/right/talker", {**common, "rate": 1.0, "text": "last"}),
    }


def test_a_node_that_keeps_its_name_is_ready_by_its_process(cluster) -> None:
    """The node is found by the pids of the instance, because its name is not known."""
    cluster.submit(node("kept-name", node_name="keep", namespace="/deep"))
    cluster.wait("kept-name", "running")
    assert said(cluster, "kept-name")["name"] == "/deep/unnamed"
    cluster.cancel("kept-name")


def test_the_environment(cluster) -> None:
    """The environment has the spec's variables and the identity, and none of the bootstrapper's.

    A node checks messages by its own and its master's identity.
    """
    code = "import json, os; print(json.dumps(dict(os.environ)))"
    cluster.run(python("who", code, kind=Kind.JOB, environment={"MINE": "yes"}, ros=True))
    environment = json.loads(cluster.log("who"))
    for absent in ("_ROS_WHEELS_BOOTSTRAP_COMPLETE", "ROSRM_SHADOW"):
        assert absent not in environment
    assert "site-packages" not in environment.get("LD_LIBRARY_PATH", "")
    assert environment["ROSRM_HOST"] in ("h0", "h1")
    expected = {
        "MINE": "yes", "ROS_DOMAIN_ID": str(cluster.domain), "ROSRM_PROCESS": "who",
        "ROSRM_NODE": "/who", "ROSRM_STATE_CONFIG": "/rosrm/state_config",
        "ROSRM_MASTER": cluster.cluster.name, "ROSRM_EPOCH": "1",
    }  # fmt: skip
    assert environment.items() >= expected.items()
    assert int(Path(environment["ROSRM_EPOCH_FILE"]).read_text()) == 1


def test_ready_is_this_instance_not_a_namesake(cluster, tmp_path) -> None:
    """A slow node is not ready although a foreign node of its name is in the graph."""
    environment = {**os.environ, **cluster.ros.environment()}
    command = [sys.executable, "-c", NODE, "--ros-args", "-r", "__node:=twin"]
    with subprocess.Popen(command, env=environment, stdout=subprocess.PIPE) as stranger:
        try:
            stranger.stdout.readline()
            go = tmp_path / "go"
            slow = (
                f"import os, time\nwhile not os.path.exists({str(go)!r}): time.sleep(0.01)\n{NODE}"
            )
            cluster.submit(node("twin", slow))
            cluster.wait("twin", "starting")
            cluster.stays(
                1.5, lambda: cluster.process("twin").state in ("starting", "assigned"), "not ready"
            )
            go.touch()
            row = cluster.wait("twin", "running")
            assert row.pid != stranger.pid
        finally:
            stranger.kill()
    cluster.cancel("twin")


def test_never_ready_is_stopped_and_has_failed(cluster) -> None:
    """The reason has the awaited node and the timeout."""
    spec = ProcessSpec(
        "mute", command=("sh", "-c", "echo $$; sleep 1000"), ros=True, namespace="/deep",
        readiness=Readiness(timeout=0.7), stop=QUICK,
    )  # fmt: skip
    row = cluster.run(spec)[0]
    assert row.state == "failed"
    assert "not ready within 0.7 s" in row.reason
    assert "/deep/mute" in row.reason
    wait_gone(int(cluster.log("mute")))


# --- restarts ---------------------------------------------------------------------------------


def test_restart_by_hand(cluster) -> None:
    """A running process restarts on its host with a new pid; an ended one is queued again."""
    cluster.submit(service("again-by-hand"))
    before = cluster.wait("again-by-hand", "running")
    cluster.client.restart(["again-by-hand"])
    cluster.wait(
        "again-by-hand", "running", host=before.host, where=lambda r: r.pid not in (0, before.pid)
    )
    cluster.cancel("again-by-hand")
    cluster.client.restart(["again-by-hand"])
    cluster.wait("again-by-hand", "running")
    cluster.cancel("again-by-hand")


# --- missing requirements ---------------------------------------------------------------------


def test_what_one_host_lacks_goes_to_another(make_cluster, ament_prefix) -> None:
    """A process refused by a host without the package runs on a host with it."""
    before = os.environ.get("AMENT_PREFIX_PATH")
    cluster = make_cluster(host("bare"))
    os.environ["AMENT_PREFIX_PATH"] = str(ament_prefix)
    try:
        cluster.add(host("full", labels={"has": "it"}))
    finally:
        os.environ.pop("AMENT_PREFIX_PATH")
        if before is not None:
            os.environ["AMENT_PREFIX_PATH"] = before
    cluster.client.set_host_state("full", "cordon")
    cluster.submit(
        ProcessSpec("picky", package="fake_package", executable="talker", ros=True, stop=CALM)
    )
    cluster.wait_for_event("queued", process="picky")
    assert cluster.process("picky").state in ("queued", "set_aside")
    cluster.client.set_host_state("full", "uncordon")
    assert cluster.wait("picky", "running").host == "full"
    cluster.cancel("picky")


# --- logs -------------------------------------------------------------------------------------


def test_a_flood_of_output_is_bounded(cluster) -> None:
    """A process with endless output neither fills the disk nor disturbs other processes."""
    cluster.submit(service("flood", "sh", "-c", "while :; do echo 0123456789012345678901234; done"))
    row = cluster.wait("flood", "running")
    logs = cluster.directory / "hosts" / row.host / "supervisor" / "logs"
    wait_until(lambda: list(logs.glob("flood.*.log.2")), "two rotations")
    for number in range(4):  # on each host
        assert cluster.run(job(f"beside-{number}", "true"))[0].state == "finished"
    cluster.cancel("flood")
    files = [path for path in logs.glob("flood.*") if path.suffix != ".times"]
    assert len(files) <= 3
    assert sum(path.stat().st_size for path in files) < 3 * 25_000


def test_reading_and_following_a_log(cluster) -> None:
    """A log can be read from start or end, and followed by offset until the process ends."""
    code = "import sys\nprint('first')\nfor line in open(sys.argv[1]): print(line, end='')"
    fifo = cluster.directory / "fifo"
    os.mkfifo(fifo)
    spec = ProcessSpec(
        "teller", command=(sys.executable, "-uISc", code, str(fifo)), kind=Kind.JOB, stop=QUICK
    )
    cluster.submit(spec)
    row = cluster.wait("teller", "running")
    with fifo.open("w") as pipe:
        cluster.wait_for_log("teller", "first")
        part = cluster.client.read_log(row.host, "teller", row.number, 0, 0)
        assert (part.content, part.ended) == (b"first\n", False)
        pipe.write("second\n")
        pipe.flush()
        cluster.wait_for_log("teller", "second")
        after = cluster.client.read_log(row.host, "teller", row.number, part.next_offset, 0)
        assert after.content == b"second\n"
        assert cluster.client.read_log(row.host, "teller", tail=1).content == b"second\n"
    assert cluster.ended("teller").state == "finished"
    last = cluster.client.read_log(row.host, "teller", row.number, after.next_offset, 0)
    assert (last.content, last.ended) == (b"", True)


def test_no_log_is_said(cluster) -> None:
    """The error names a process that never ran on the host."""
    with pytest.raises(Refused, match="no log of nobody"):
        cluster.client.read_log("h0", "nobody", 0, 0, 0)
