"""CPU and memory of an idle slave, compared with bare rclpy nodes.

A registered slave at 10 Hz without processes, with its supervisor, and in the same rounds two bare
rclpy nodes. Each publishes a message of the size of a reading at 10 Hz from a timer:

- `connected` communicates as a slave does: a node in another process receives its messages, and
  publishes a message of the size of a beat at the rate of the master's beats, which `connected`
  receives with an empty callback.
- `bare` has no peer, so it sends and receives nothing.

CPU time is that of all threads, as the scheduler counts it. CPU times, wake-ups and ratios of CPU
time are medians of the rounds. Memory is PSS: a page that N processes share counts 1/N for each.
It is measured while `bare` is the only bare node, because two of them would share pages, and each
would seem smaller.

Then a slave with two nodes between which 30 MB/s flow, with and without `network.learn`: the CPU
time of the slave alone. The first sample of the flow is within the measured time.
"""

from __future__ import annotations

import contextlib
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from statistics import median

import psutil

from benchmarks.machine import parser, print_report
from benchmarks.stopping import run
from rosrm.config.settings import ClusterConfig, HostConfig, NetworkSettings
from rosrm.model.values import ProcessSpec
from rosrm.testing.local_cluster import LocalCluster

#: End of each program.
_SPIN = """
print("ready", flush=True)
try:
    rclpy.spin(node)
except BaseException:  # however its context ends, the program ends with success
    pass
"""
#: Arguments: the own topic; the topic of the peer, or "" for none. Neither this program nor the
#: peer imports a module of rosrm, because some of these modules prevent imports of rclpy, and a
#: bare node has all of them.
_BARE = """
import sys
from array import array

import rclpy
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rosrm_msgs.msg import SealedReading, Signed

own, other = sys.argv[1:]
rclpy.init()
node = Node(own)
newest = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
publisher = node.create_publisher(SealedReading, own, newest)
message = SealedReading(format=1, body=array("B", bytes(216)))
node.create_timer(0.1, lambda: publisher.publish(message))
if other:
    node.create_subscription(Signed, other, lambda _: None, newest)
"""
#: Arguments: the own topic, the topic of the bare node, and the seconds between two beats.
_PEER = """
import sys
from array import array

import rclpy
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rosrm_msgs.msg import SealedReading, Signed

own, other, period = sys.argv[1:]
rclpy.init()
node = Node(own)
latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
publisher = node.create_publisher(Signed, own, latched)
message = Signed(
    format=1, run=array("B", bytes(16)), signature=array("B", bytes(80)),
    body=array("B", bytes(120)),
)
all_readings = QoSProfile(depth=4000, reliability=ReliabilityPolicy.BEST_EFFORT)
node.create_timer(float(period), lambda: publisher.publish(message))
node.create_subscription(SealedReading, other, lambda _: None, all_readings)
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
"""
_MIB = 2.0**20
#: Seconds for new nodes to be discovered.
_SETTLE = 3.0


def cpu_seconds(processes: Sequence[psutil.Process]) -> float:
    """Return the CPU time of the running threads of these processes so far."""
    counts = [
        (task / "schedstat").read_text()
        for process in processes
        for task in Path(f"/proc/{process.pid}/task").iterdir()
    ]
    return sum(int(one.split()[0]) for one in counts) * 1e-9


def wake_ups(processes: Sequence[psutil.Process]) -> int:
    """Return the number of voluntary context switches of the running threads of these processes."""
    return sum(
        psutil.Process(thread.id).num_ctx_switches().voluntary
        for process in processes
        for thread in process.threads()
    )


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


@contextlib.contextmanager
def _program(program: str, *words: str) -> Iterator[psutil.Process]:
    """Run a Python program, `_SPIN` at its end."""
    line = [sys.executable, "-c", program + _SPIN, *words]
    running = subprocess.Popen(line, stdout=subprocess.PIPE, stdin=subprocess.DEVNULL)
    try:
        assert running.stdout is not None
        if running.stdout.readline() != b"ready\n":
            raise RuntimeError("a bare node did not come up")
        yield psutil.Process(running.pid)
    finally:
        running.terminate()
        running.wait(10.0)


def main() -> None:
    """Measure and print one JSON object."""
    command_line = parser(__doc__)
    command_line.add_argument(
        "--seconds", type=float, default=10.0, help="duration of each round in seconds, e.g. 10"
    )
    command_line.add_argument(
        "--rounds",
        type=int,
        default=5,
        help="number of rounds; the results are the medians of all rounds, e.g. 5",
    )
    arguments = command_line.parse_args()
    beats = str(ClusterConfig().control.beat_period)
    with (
        tempfile.TemporaryDirectory(prefix="rosrm-slave-cost-") as folder,
        LocalCluster(Path(folder), hosts=[HostConfig(host="host0")]) as cluster,
        _program(_BARE, "bare", "") as bare,
    ):
        slave = psutil.Process(cluster.slaves["host0"].process.pid)
        supervisor = supervisor_of(slave, Path(folder))
        measured = {"slave": [slave, supervisor], "supervisor": [supervisor], "bare": [bare]}
        cluster.client.spin(arguments.seconds)
        result = {f"{name}_pss_mib": pss_mib(of) for name, of in measured.items()}
        with (
            _program(_BARE, "connected", "peer") as connected,
            _program(_PEER, "peer", "connected", beats),
        ):
            measured["connected"] = [connected]
            cluster.client.spin(_SETTLE)
            rounds = [_round(cluster, measured, arguments.seconds) for _ in range(arguments.rounds)]
    result |= {key: median(one[key] for one in rounds) for key in rounds[0]}
    result["pss_mib_over_bare"] = result["slave_pss_mib"] / result["bare_pss_mib"]
    for learn in (False, True):
        with tempfile.TemporaryDirectory(prefix="rosrm-slave-cost-") as folder:
            used, rate = _with_flow(Path(folder), 2.0 * arguments.seconds, learn=learn)
        result[f"slave_cpu_beside_a_flow{'_learned' if learn else ''}"] = used
        result["learned_rate"] = rate
    print_report("slave_cost", result, runs=arguments.rounds)


def _with_flow(folder: Path, seconds: float, *, learn: bool) -> tuple[float, float]:
    """Return the cores that a slave uses beside two nodes, and the learned rate of their flow."""
    nodes = [
        ProcessSpec(
            name,
            command=(sys.executable, "-c", _NODE + _SPIN, name),
            ros=True,
            needs={"memory": _MIB},
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


def _round(
    cluster: LocalCluster, measured: Mapping[str, Sequence[psutil.Process]], seconds: float
) -> dict[str, float]:
    """Return the CPU time and the wake-ups of one round."""
    began = time.monotonic()
    before = {name: (cpu_seconds(of), wake_ups(of)) for name, of in measured.items()}
    while time.monotonic() - began < seconds:
        cluster.client.spin(0.5)
    elapsed = time.monotonic() - began
    found: dict[str, float] = {"seconds": elapsed}
    for name, processes in measured.items():
        cpu, waits = before[name]
        found[f"{name}_cpu"] = (cpu_seconds(processes) - cpu) / elapsed
        found[f"{name}_wake_ups_per_s"] = (wake_ups(processes) - waits) / elapsed
    for name in ("bare", "connected"):
        found[f"cpu_over_{name}"] = found["slave_cpu"] / found[f"{name}_cpu"]
    return found


if __name__ == "__main__":
    sys.exit(run("slave_cost", main))
