"""CPU and memory of an idle slave, compared with a bare rclpy node.

A registered slave at 10 Hz without processes, with its supervisor, and in the same run a bare rclpy
node that publishes the same message at 10 Hz from a timer. CPU time covers all threads over the
measured time. Memory is PSS, so that pages shared by several processes count once.

Then a slave with two nodes between which 30 MB/s flow, with and without `network.learn`: the CPU
time of the slave alone. The first sample of the flow is within the measured time.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

import psutil

from benchmarks.machine import parser, print_report
from benchmarks.stopping import run
from rosrm.config.settings import ClusterConfig, HostConfig, NetworkSettings
from rosrm.model.values import ProcessSpec
from rosrm.testing.local_cluster import LocalCluster

_BARE = """
import rclpy
from rclpy.node import Node
from rosrm_msgs.msg import SealedReading

rclpy.init()
node = Node("bare")
publisher = node.create_publisher(SealedReading, "bare_resource_info", 1)
message = SealedReading(format=1)
node.create_timer(0.1, lambda: publisher.publish(message))
print("ready", flush=True)
rclpy.spin(node)
"""
_NODE = """
import sys, rclpy
from rclpy.node import Node
from std_msgs.msg import String

rclpy.init()
node = Node("unnamed")
if sys.argv[1] == "camera":
    publisher = node.create_publisher(String, "image", 1)
    image = String(data="x" * 1_000_000)
    node.create_timer(1 / 30, lambda: publisher.publish(image))
else:
    node.create_subscription(String, "image", lambda _: None, 1)
try:
    rclpy.spin(node)
except BaseException:  # however its context ends, the program ends with success
    pass
"""
_MIB = 2.0**20


def cpu_seconds(processes: Sequence[psutil.Process]) -> float:
    """Return the user and system time of these processes so far."""
    return sum(sum(process.cpu_times()[:2]) for process in processes)


def pss_mib(processes: Sequence[psutil.Process]) -> float:
    """Return the proportional set size, summed."""
    return float(sum(process.memory_full_info().pss for process in processes)) / _MIB


def supervisor_of(slave: psutil.Process, directory: Path) -> psutil.Process:
    """Return the supervisor that serves the slave's state directory."""
    for process in psutil.process_iter(["cmdline"]):
        line = process.info["cmdline"] or []
        if any("supervisor" in word for word in line) and any(str(directory) in w for w in line):
            return process
    raise LookupError(f"no supervisor for {directory} (slave pid {slave.pid})")


def main() -> None:
    """Measure and print one JSON object."""
    command_line = parser(__doc__)
    command_line.add_argument("--seconds", type=float, default=30.0, help="of the measurement")
    seconds = command_line.parse_args().seconds
    with (
        tempfile.TemporaryDirectory(prefix="rosrm-slave-cost-") as folder,
        LocalCluster(Path(folder), hosts=[HostConfig(host="host0")]) as cluster,
    ):
        bare = subprocess.Popen(
            [sys.executable, "-c", _BARE], stdout=subprocess.PIPE, stdin=subprocess.DEVNULL
        )
        try:
            assert bare.stdout is not None
            if bare.stdout.readline() != b"ready\n":
                raise RuntimeError("the bare node did not come up")
            result = _measure(cluster, psutil.Process(bare.pid), Path(folder), seconds)
        finally:
            bare.terminate()
            bare.wait(10.0)
    for learn in (False, True):
        with tempfile.TemporaryDirectory(prefix="rosrm-slave-cost-") as folder:
            used, rate = _with_flow(Path(folder), seconds, learn=learn)
        result[f"slave_cpu_beside_a_flow{'_learned' if learn else ''}"] = used
        result["learned_rate"] = rate
    print_report("slave_cost", result, runs=1)


def _with_flow(folder: Path, seconds: float, *, learn: bool) -> tuple[float, float]:
    """Return the cores that a slave uses beside two nodes, and the learned rate of their flow."""
    nodes = [
        ProcessSpec(
            name, command=(sys.executable, "-c", _NODE, name), ros=True, needs={"memory": _MIB}
        )
        for name in ("camera", "viewer")
    ]
    # Without a reading of the CPU, so that the load of the machine does not keep the nodes away.
    host = HostConfig(host="host0", probes={"memory": {}})
    settings = ClusterConfig(network=NetworkSettings(period=2.0, learn=learn))
    with LocalCluster(folder, settings, [host]) as cluster:
        slave = psutil.Process(cluster.slaves["host0"].process.pid)
        cluster.client.submit(nodes)
        while any(row.state != "running" for row in cluster.client.list(processes=True).processes):
            cluster.client.spin(0.2)
        before, begun = cpu_seconds([slave]), time.monotonic()
        while time.monotonic() - begun < seconds:
            cluster.client.spin(0.5)
        used = (cpu_seconds([slave]) - before) / (time.monotonic() - begun)
        return used, sum(one["rate"] for one in cluster.client.explain("viewer")["flows"])


def _measure(
    cluster: LocalCluster, bare: psutil.Process, folder: Path, seconds: float
) -> dict[str, float]:
    slave = psutil.Process(cluster.slaves["host0"].process.pid)
    supervisor = supervisor_of(slave, folder)
    ours = [slave, supervisor]
    cluster.client.spin(3.0)
    slave_before, bare_before, begun = cpu_seconds(ours), cpu_seconds([bare]), time.monotonic()
    supervisor_before = cpu_seconds([supervisor])
    while time.monotonic() - begun < seconds:
        cluster.client.spin(0.5)
    elapsed = time.monotonic() - begun
    return {
        "slave_cpu": (cpu_seconds(ours) - slave_before) / elapsed,
        "bare_cpu": (cpu_seconds([bare]) - bare_before) / elapsed,
        "supervisor_cpu": (cpu_seconds([supervisor]) - supervisor_before) / elapsed,
        "slave_pss_mib": pss_mib(ours),
        "bare_pss_mib": pss_mib([bare]),
        "supervisor_pss_mib": pss_mib([supervisor]),
        "seconds": elapsed,
    }


if __name__ == "__main__":
    sys.exit(run("slave_cost", main))
