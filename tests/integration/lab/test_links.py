"""Links of virtual hosts: their rates and delays, measured by real slaves, decide placement."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Mapping
from typing import Any

import pytest

from rosrm.errors import LabError
from rosrm_lab import MIB, HostPlan, Lab
from tests.integration.lab.test_cluster import PATIENCE, Cluster

MB = 1e6
RATE = 5 * MB
#: Probes of a host, so that the CPU load of the machine does not keep processes away.
PROBES = "probes: [memory]\n"
#: Sends about the given number of bytes a second to a host until it is ended.
SEND = """
import socket, sys, time
s, rate = socket.socket(socket.AF_INET, socket.SOCK_DGRAM), float(sys.argv[2])
began, sent = time.monotonic(), 0
while True:
    if sent < rate * (time.monotonic() - began):
        sent += s.sendto(b'x' * 1000, (sys.argv[1], 9200))
    else:
        time.sleep(0.005)
"""


@pytest.fixture
def cluster(name, tmp_path):
    """Yield a cluster of robot-1, behind a link of 5 MB/s, and base, with quick measurements."""
    hosts = [HostPlan(one, disk=64 * MIB) for one in ("robot-1", "base", "desk")]
    (tmp_path / "cluster.yaml").write_text(
        "network: {period: 500ms}\nscoring: {policy: network}\n"
        "liveness: {suspect: 5s, lease: 60s}\n"
    )
    (tmp_path / "robot-1.yaml").write_text(
        f"labels: {{at: robot}}\nlinks: {{rate: 5MB/s}}\n{PROBES}"
    )
    (tmp_path / "base.yaml").write_text(f"labels: {{at: base}}\n{PROBES}")
    with Lab(name, hosts) as lab:
        lab.rate("robot-1", RATE)
        made = Cluster(lab, tmp_path)
        made.start("desk", "master", "--config", str(tmp_path / "cluster.yaml"))
        for host in ("robot-1", "base"):
            made.start(host, "slave", "--config", str(tmp_path / f"{host}.yaml"))
        yield made
    for part in made.started:  # the lab has ended them
        part.wait(PATIENCE)


def process(name: str, **fields: object) -> dict[str, Any]:
    needs = {"memory": "1MiB"}
    return {"name": name, "command": ["sleep", "1000"], "needs": needs, **fields}


def explained(cluster: Cluster, name: str) -> Mapping[str, Any]:
    found: Mapping[str, Any] = json.loads(cluster.ask("explain", name, "--json"))
    return found


def reason(cluster: Cluster, name: str, host: str) -> str:
    hosts = explained(cluster, name)["decision"]["hosts"]
    return str(next(one["reason"] for one in hosts if one["name"] == host))


def measured(cluster: Cluster, name: str, what: str) -> float:
    """Return the `round_trip` or `link_rate` of the only flow of a process; 0: not known yet."""
    (flow,) = explained(cluster, name)["flows"]
    return float(flow[what] or 0.0)


def round_trip(cluster: Cluster, name: str) -> float:
    return measured(cluster, name, "round_trip")


def delayed(lab: Lab, host: str, seconds: float) -> bool:
    """Delay the packets of a host; return False on a kernel without netem."""
    try:
        lab.delay(host, seconds)
    except LabError:
        return False
    return True


@pytest.mark.timeout(400)
def test_measured_links_decide_where_processes_run(cluster) -> None:
    """The flow that the link cannot carry stays local; real traffic takes room of the link."""
    lab = cluster.lab
    cluster.wait_for_hosts(**{"robot-1": ["up"], "base": ["up"]})
    robot, base = ({"labels": {"required": {"at": at}}} for at in ("robot", "base"))
    viewer = process("viewer", talks_to={"camera": "1MB/s"}, **base)
    cluster.submit(process("camera", **robot), viewer)
    near = cluster.wait("a round trip", lambda: round_trip(cluster, "viewer"), bool)
    assert near < 1.0
    cluster.wait(
        "the robot's report of its link", lambda: measured(cluster, "viewer", "link_rate"),
        lambda rate: rate == RATE,
    )  # fmt: skip
    if delayed(lab, "robot-1", 0.2):
        cluster.wait("the delay", lambda: round_trip(cluster, "viewer"), lambda it: 0.4 <= it < 2.0)
        lab.delay("robot-1", 0.0)

    cluster.submit(process("detector", talks_to={"camera": "20MB/s"}))
    found = cluster.wait(
        "the detector", cluster.processes, lambda p: p["detector"]["state"] == "running"
    )
    assert found["detector"]["host"] == "robot-1"
    why = reason(cluster, "detector", "base")
    assert why.startswith("20 MB/s from camera on robot-1 would cross a 5 MB/s link")

    sender = lab.popen(
        "robot-1", [sys.executable, "-ISc", SEND, lab.address("desk"), str(3.5 * MB)],
        stdout=subprocess.DEVNULL,
    )  # fmt: skip
    try:
        # The record of its flows shows no traffic, so a process of the same flow waits.
        probe = process("second", talks_to={"camera": "3MB/s"}, **base)
        cluster.submit(process("idle", **base))
        cluster.wait("traffic on the link", lambda: _refused(cluster, probe), bool)
    finally:
        sender.terminate()
        sender.wait(PATIENCE)
    cluster.wait("room on the link", cluster.processes, lambda p: p["second"]["state"] == "running")


def _refused(cluster: Cluster, probe: dict[str, Any]) -> bool:
    """Submit a process, and return True if it waits because of traffic on the link.

    Before the traffic is measured, the process runs; then it is cancelled and submitted again.
    """
    cluster.submit(probe)
    name = probe["name"]
    state = cluster.wait(
        "a decision", lambda: cluster.processes()[name]["state"],
        lambda state: state in ("running", "queued", "set_aside"),
    )  # fmt: skip
    if state == "running":
        cluster.ask("cancel", name)
        cluster.wait(
            "its end", lambda: cluster.processes().get(name, {}).get("state", ""),
            lambda state: state in ("", "cancelled"),
        )  # fmt: skip
        return False
    return "MB/s in use" in reason(cluster, name, "base")
