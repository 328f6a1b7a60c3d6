"""A real master and real slaves on virtual hosts, whose resources are the lab's limits."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

import pytest

from rosrm_lab import DATA, GIB, MIB, HostPlan, Lab, uniform
from rosrm_launch.beside import completed
from rosrm_launch.model import LaunchModel
from rosrm_launch.translate import translated
from tests.launch_files import make_package, stored
from tests.ros.clusters import NODE
from tests.waiting import command_of, wait_until

ROSRM = str(Path(sys.executable).parent / "rosrm")
#: Seconds allowed on a busy machine; no wait takes so long unless a test fails.
PATIENCE = 180.0
MEMORY = 512 * MIB
#: Exit status of `rosrm` while the master is starting.
NO_MASTER_YET = 3


class Cluster:
    """A master on `desk`, and slaves on the other hosts."""

    def __init__(self, lab: Lab, logs: Path):
        self.lab = lab
        self.logs = logs
        self.started: list[subprocess.Popen] = []

    def start(self, host: str, *words: str, **options) -> subprocess.Popen:
        with (self.logs / f"{host}-{words[0]}.log").open("ab") as log:
            part = self.lab.popen(host, [ROSRM, *words], stdout=log, stderr=log, **options)
        self.started.append(part)
        return part

    def ask(self, *words: str) -> str:
        return self.lab.exec("desk", [ROSRM, *words], timeout=PATIENCE).stdout

    def hosts(self) -> dict[str, dict]:
        """Return the rows by host; {} while no master answers, or while the machine is too busy."""
        try:
            done = self.lab.exec("desk", [ROSRM, "hosts", "--json"], check=False)
        except subprocess.TimeoutExpired:  # the waits have limits of their own
            return {}
        if done.returncode == NO_MASTER_YET:
            return {}
        return {row["name"]: row for row in json.loads(done.stdout)}

    def processes(self) -> dict[str, dict]:
        return {row["name"]: row for row in json.loads(self.ask("ps", "--json"))}

    def wait(self, what: str, look, condition):
        """Repeat `look` until its result meets the condition; a failure shows the last result."""
        looks = []

        def met() -> bool:
            looks.append(look())
            return condition(looks[-1])

        wait_until(
            met, what, PATIENCE, seen=lambda: f"{looks[-1]}\n{self.said()}",
            pause=lambda _: time.sleep(0.2),  # each look is a command
        )  # fmt: skip
        return looks[-1]

    def wait_for_hosts(self, **states: str):
        return self.wait(
            f"hosts {states}",
            self.hosts,
            lambda rows: all(n in rows and rows[n]["state"] in s for n, s in states.items()),
        )

    def said(self) -> str:
        return "".join(f"{p.name}:\n{p.read_text()[-1500:]}\n" for p in self.logs.glob("*.log"))

    def submit(self, *processes: dict) -> None:
        file = self.logs / "work.yaml"
        file.write_text(json.dumps({"processes": list(processes)}))
        self.ask("submit", str(file))


@pytest.fixture
def cluster(name, tmp_path):
    """Yield a cluster of two hosts (512 MiB, half a core each), and a desk without a quota."""
    hosts = uniform(2, memory=MEMORY, cpu=0.5, disk=64 * MIB)
    with Lab(name, [*hosts, HostPlan("desk", disk=64 * MIB)]) as lab:
        made = Cluster(lab, tmp_path)
        made.start("desk", "master")
        yield made
    for part in made.started:  # the lab has ended them
        part.wait(PATIENCE)


def holding(name: str, megabytes: int) -> dict:
    hold = f"x = bytearray({megabytes} << 20); print('held', flush=True)"
    return {
        "name": name,
        "command": [sys.executable, "-ISc", f"{hold}; import time; time.sleep(999)"],
        "needs": {"memory": f"{megabytes}MiB", "cpu": 0.1},
    }


@pytest.mark.timeout(300)
def test_processes_go_to_the_hosts_that_have_room(cluster):
    """Slaves without a host file measure the lab host; two large processes get two hosts.

    Then one host is disconnected and healed, loses its power and boots: its service restarts.
    """
    for host in ("host1", "host2"):
        cluster.start(host, "slave")
    rows = cluster.wait_for_hosts(host1=["up"], host2=["up"])
    for host, row in rows.items():
        capacity = {one["name"]: (one["capacity"], one["scope"]) for one in row["resources"]}
        assert row["hostname"] == host
        assert capacity["memory"] == (MEMORY, "cgroup")
        assert capacity["cpu"] == (0.5, "cgroup")
        assert 50 * MIB < capacity["disk"][0] <= 64 * MIB

    cluster.submit(holding("a", 250), holding("b", 250))
    running = cluster.wait(
        "both run", cluster.processes, lambda p: {one["state"] for one in p.values()} == {"running"}
    )
    assert {one["host"] for one in running.values()} == {"host1", "host2"}
    assert cluster.ask("logs", "a") == "held\n"
    cluster.wait(
        "memory is seen against the limit of the host",
        lambda: {
            one["name"]: one["usage"] for one in cluster.hosts()["host1"]["resources"]
        }["memory"],
        lambda usage: usage > 250 * MIB / MEMORY,
    )  # fmt: skip

    cluster.lab.cut("host2")
    cluster.wait_for_hosts(host1=["up"], host2=["suspect", "lost"])
    cluster.lab.heal("host2")
    cluster.wait_for_hosts(host1=["up"], host2=["up"])
    assert {one["state"] for one in cluster.processes().values()} == {"running"}

    cluster.lab.kill("host2")
    cluster.wait_for_hosts(host1=["up"], host2=["lost"])
    cluster.lab.boot("host2")
    cluster.start("host2", "slave")
    cluster.wait_for_hosts(host1=["up"], host2=["up"])
    again = cluster.wait(
        "both run again", cluster.processes,
        lambda p: {one["state"] for one in p.values()} == {"running"},
    )  # fmt: skip
    assert {n: one["host"] for n, one in again.items()} == {
        n: one["host"] for n, one in running.items()
    }


@pytest.mark.timeout(300)
def test_a_slave_beside_the_quota_of_its_jobs(cluster):
    """The lab's limits apply to the jobs alone; the slave outside measures the jobs' group."""
    lab, state = cluster.lab, f"{DATA}/slave"
    lab.supervise("host1", state)
    probes = {resource: {"group": lab.group("host1")} for resource in ("cpu", "memory")}
    settings = {"host": "host1", "state": state, "probes": {**probes, "disk": {}}}
    lab.outside("host1", "host.yaml").write_text(json.dumps(settings))
    words = ("slave", "--config", f"{DATA}/host.yaml")
    slave = cluster.start("host1", *words, limited=False)
    rows = cluster.wait_for_hosts(host1=["up"])
    capacity = {one["name"]: one["capacity"] for one in rows["host1"]["resources"]}
    assert (capacity["memory"], capacity["cpu"]) == (MEMORY, 0.5)

    group = {"name": "group", "kind": "job", "command": ["cat", "/proc/self/cgroup"]}
    cluster.submit(group)
    cluster.wait(
        "the job ends", cluster.processes, lambda p: p["group"]["state"] in ("finished", "failed")
    )
    limits = cluster.ask("logs", "group")
    assert f":{lab.group('host1')}/rosrm-state-" in limits  # its own group, below the limited one
    inner = [pid for pid in lab.pids("host1") if "rosrm.slave" in command_of(pid)]
    assert inner
    assert lab.group("host1") not in Path(f"/proc/{inner[0]}/cgroup").read_text()
    assert slave.poll() is None


@pytest.mark.timeout(300)
def test_a_launch_file_runs_on_two_hosts(cluster, tmp_path):
    """The model that a real `launch` printed; nodes of one name run on hosts of their own."""
    prefix, settings = tmp_path / "install", tmp_path / "talkers.rosrm.yaml"
    make_package(prefix, NODE)
    for host in ("host1", "host2"):
        cluster.start(host, "slave", env={"AMENT_PREFIX_PATH": str(prefix)})
    cluster.wait_for_hosts(host1=["up"], host2=["up"])
    settings.write_text("nodes: {/left/driver: {apart: right.driver}}\n")
    translation = translated(LaunchModel.model_validate(stored("talkers.launch.py")))
    work = completed(translation, Path("talkers.launch.py"), settings)
    (tmp_path / "talkers.json").write_text(json.dumps(work.plain()))
    cluster.ask("apply", str(tmp_path / "talkers.json"))
    rows = cluster.processes()
    assert {row["state"] for row in rows.values()} == {"running"}
    assert {rows["left.driver"]["host"], rows["right.driver"]["host"]} == {"host1", "host2"}
    for side in ("left", "right"):
        said = cluster.wait(
            f"{side}.driver prints its name", partial(cluster.ask, "logs", f"{side}.driver"),
            lambda log: '"topic"' in log,
        )  # fmt: skip
        assert f'"name": "/{side}/driver"' in said
    assert f"{prefix}/share/demo_robot/maps/hall.yaml" in cluster.ask("logs", "left.driver")


@pytest.mark.timeout(300)
def test_ten_hosts_find_one_master(name, tmp_path):
    """Ten slaves find the master by multicast discovery, as in the evaluation."""
    hosts = uniform(10, memory=GIB // 2, disk=32 * MIB)
    with Lab(name, [*hosts, HostPlan("desk", disk=64 * MIB)]) as lab:
        cluster = Cluster(lab, tmp_path)
        cluster.start("desk", "master")
        for host in hosts:
            cluster.start(host.name, "slave")
        cluster.wait_for_hosts(**{host.name: ["up"] for host in hosts})
    for part in cluster.started:
        part.wait(PATIENCE)
