"""Cost of snapshots for a node, per cycle.

A node has a timer of 10 ms and a state of a given size, which changes in every cycle. It runs in a
process of its own, with and without snapshots by turns; the median of the rounds counts. `mean_us`,
`p50_us`, `p99_us`: from the author's callback until the node is ready for the next one. `cpu_us`:
CPU time of the whole process per cycle, with its executor and the writer of snapshots.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from array import array
from typing import Any

import numpy as np
import rclpy
from std_msgs.msg import UInt8MultiArray

from benchmarks.machine import parser, percentile, print_report, say
from benchmarks.stopping import run
from rosrm.node import Node
from rosrm.testing.loopback import enter_private_network

SIZES = (100, 100_000, 1_000_000, 5_000_000)


def node(size: int, cycles: int) -> None:
    """Print the seconds of each cycle; runs in the child process."""
    enter_private_network()
    rclpy.init()

    class Changing(Node):
        def __init__(self) -> None:
            super().__init__("changing")
            self.state = np.zeros(size, np.uint8)
            self.count = 0
            self.keep_state("~/state", UInt8MultiArray, self.save, lambda _: None)
            self.create_timer(0.01, self.tick)

        def tick(self) -> None:
            self.count += 1
            self.state[self.count % size] += 1

        def save(self) -> Any:
            return UInt8MultiArray(data=array("B", self.state.tobytes()))

    changing = Changing()
    session = changing._rosrm  # noqa: SLF001
    assert session is not None
    entities, took = session.entities, list[float]()
    inner = entities._cycle  # noqa: SLF001

    def timed(*arguments: Any) -> Any:
        begun = time.perf_counter()
        result = inner(*arguments)
        took.append(time.perf_counter() - begun)
        return result

    entities._cycle = timed  # type: ignore[assignment,method-assign]  # noqa: SLF001
    while changing.count < cycles // 10:
        rclpy.spin_once(changing)
    took.clear()
    cpu = time.process_time()
    while changing.count < cycles + cycles // 10:
        rclpy.spin_once(changing)
    cpu = time.process_time() - cpu
    figures = {
        "mean_us": statistics.fmean(took) * 1e6,
        "p50_us": percentile(took, 0.5) * 1e6,
        "p99_us": percentile(took, 0.99) * 1e6,
        "cpu_us": cpu / len(took) * 1e6,
    }
    print(json.dumps({name: round(value, 1) for name, value in figures.items()}), flush=True)
    changing.destroy_node()
    rclpy.try_shutdown()


def measured(size: int, cycles: int, *, keep: bool) -> dict[str, float]:
    """Return the figures of one run."""
    with tempfile.TemporaryDirectory() as directory:
        environment = {
            **os.environ, "ROSRM_PROCESS": "changing", "ROSRM_INSTANCE": "changing#1",
            "ROSRM_STATE_CONFIG": "/rosrm/state_config", "ROS_DOMAIN_ID": "77",
        }  # fmt: skip
        if keep:
            environment["ROSRM_KEEP"] = directory
        run = subprocess.run(
            [sys.executable, "-m", "benchmarks.keep_cost", "--node", str(size), "--cycles",
             str(cycles)],
            env=environment, capture_output=True, text=True, check=True, timeout=300,
        )  # fmt: skip
    return dict(json.loads(run.stdout.splitlines()[-1]))


def main() -> None:
    command_line = parser(__doc__)
    command_line.add_argument("--node", type=int, help=argparse.SUPPRESS)
    command_line.add_argument("--cycles", type=int, default=1000, help="cycles of each node")
    command_line.add_argument(
        "--rounds", type=int, default=3, help="runs with and without snapshots"
    )
    options = command_line.parse_args()
    if options.node is not None:
        node(options.node, options.cycles)
        return
    table: dict[str, Any] = {}
    for size in SIZES:
        rounds: dict[bool, list[dict[str, float]]] = {False: [], True: []}
        for _ in range(options.rounds):
            for keep in (False, True):
                rounds[keep].append(measured(size, options.cycles, keep=keep))
        row = {
            word: {
                name: statistics.median(one[name] for one in rounds[keep])
                for name in rounds[keep][0]
            }
            for keep, word in ((False, "without"), (True, "with"))
        }
        table[str(size)] = row
        say(f"{size} bytes: {json.dumps(row)}")
    print_report("keep_cost", {"cycles": options.cycles, "by_size": table}, runs=options.rounds)


if __name__ == "__main__":
    sys.exit(run("keep_cost", main))
