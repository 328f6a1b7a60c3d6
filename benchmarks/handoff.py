"""Outputs of a node during many migrations between two hosts, at an external observer.

`--strategy handoff` (the default): a stateful node answers the inputs of a driver, or counts by a
timer of its own (`--driven timer`), while it migrates to and fro. Lost, repeated and out of order
are counted in its answers. The gap is the time from the source's last output to the destination's
first, minus the time between the inputs that they answer (`--driven timer`: minus one period).
`--strategy relaunch`: a stateless node publishes in each cycle. The gap is the same, minus one
period, and negative if both were active for a moment. Lost are the cycles in which no instance was
active, repeated those in which both were.
"""

from __future__ import annotations

import contextlib
import itertools
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from std_msgs.msg import Int64MultiArray

from benchmarks.handoff_nodes import OUTPUT, QOS
from benchmarks.hosts import three_hosts
from benchmarks.machine import isolated_transports, parser, percentile, print_report, say
from benchmarks.stopping import run
from rosrm.config.settings import ClusterConfig, MigrationSettings
from rosrm.keys.roles import SecurityMode
from rosrm.model.values import MigrationPolicy, ProcessSpec
from rosrm.testing.local_cluster import LocalCluster

_ROOT = Path(__file__).resolve().parents[1]
_NS = 1e9
#: Seconds of undisturbed output before and after each migration.
_SETTLE = 0.5
#: Seconds within which a migration must have ended, with success or not.
_PATIENCE = 60.0
_NAME = "moving"


class Output(NamedTuple):
    """One output as the observer received it.

    Attributes:
        received: by DDS, unix time in ns.
        instance: the number of its publisher.
        sequence: outputs of the node so far, with this one; 0 for a stateless node.
        answered: the input that it answers, numbered from 1.
        sent: unix time of that input in ns; 0: the node has no driver.
    """

    received: int
    instance: int
    sequence: int
    answered: int
    sent: int = 0


@dataclass
class Outcome:
    """The ends of the migrations, and their costs as seen by the observer.

    Attributes:
        ends: "migrated" or "stayed", of each migration.
        gaps: seconds beyond the time between two inputs, of each change of the publisher.
        lost, repeated, out_of_order: outputs, or inputs without an answer or with several.
        moves: seconds from each request to the end of its migration.
        driver_late: most seconds by which the input of a destination's first output was late.
    """

    ends: list[str]
    gaps: list[float]
    lost: int
    repeated: int
    out_of_order: int
    moves: list[float] = field(default_factory=list)
    driver_late: float = 0.0


class Observer:
    """Recorder of every output, in a participant and a thread of its own."""

    def __init__(self, domain: int | None) -> None:
        self.outputs: list[Output] = []
        self._context = rclpy.Context()
        rclpy.init(
            context=self._context, domain_id=domain, signal_handler_options=SignalHandlerOptions.NO
        )
        self._node = Node("handoff_observer", context=self._context)
        self._node.create_subscription(Int64MultiArray, OUTPUT, self._take, QOS)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)
        self._thread = threading.Thread(target=self._executor.spin, daemon=True)
        self._thread.start()

    def _take(self, message: Int64MultiArray, info: Any) -> None:
        self.outputs.append(Output(info["received_timestamp"], *message.data))

    def wait_for(self, count: int, timeout: float = _PATIENCE) -> None:
        """Wait for so many more outputs."""
        target, deadline = len(self.outputs) + count, time.monotonic() + timeout
        while len(self.outputs) < target:
            if time.monotonic() >= deadline:
                raise TimeoutError(f"{count} more outputs were not received within {timeout:g} s")
            time.sleep(0.01)

    def close(self) -> None:
        self._executor.shutdown()
        self._thread.join(5.0)
        self._node.destroy_node()
        self._context.try_shutdown()


@contextlib.contextmanager
def driver(cluster: LocalCluster, rate: float) -> Iterator[None]:
    """Run the driver, which publishes inputs at a rate, in a process of its own."""
    environment = {**os.environ, **cluster.ros.environment(), "ROS_DOMAIN_ID": str(cluster.domain)}
    process = subprocess.Popen(
        [sys.executable, "-m", "benchmarks.handoff_nodes", "drive", "--rate", str(rate)],
        cwd=_ROOT, env=environment, start_new_session=True,
    )  # fmt: skip
    try:
        yield
    finally:
        process.send_signal(signal.SIGINT)
        try:
            process.wait(5.0)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait(5.0)


def process_of(strategy: str, program: str, rate: float) -> ProcessSpec:
    """Return the node that is migrated; `rate` in Hz."""
    return ProcessSpec(
        _NAME, module="benchmarks.handoff_nodes", arguments=(program, "--rate", str(rate)),
        environment={"PYTHONPATH": str(_ROOT)}, ros=True,
        migration=MigrationPolicy(strategy=strategy),
    )  # fmt: skip


def move(cluster: LocalCluster) -> str:
    """Migrate the process to the other host; return "migrated" or "stayed"."""
    cluster.wait_until("the process running", lambda view: view.processes[0].state == "running")
    last = cluster.client.list(events=True, newest=1).events[-1].sequence
    here = cluster.process(_NAME).host
    there = next(name for name in cluster.slaves if name != here)
    cluster.client.migrate(_NAME, there)
    deadline = time.monotonic() + _PATIENCE
    while time.monotonic() < deadline:
        events = cluster.client.list(events=True, process=_NAME, after=last).events
        for event in events:
            if event.kind in ("migrated", "stayed"):
                if event.kind == "stayed":
                    say(event.message)
                return str(event.kind)
        cluster.client.spin(0.05)
    raise TimeoutError(f"the migration to {there} did not end within {_PATIENCE:g} s")


def changes(outputs: Sequence[Output]) -> list[tuple[Output, Output]]:
    """Return the last output of each source with the first of its destination."""
    pairs = itertools.pairwise(outputs)
    return [(before, after) for before, after in pairs if before.instance != after.instance]


def gap(before: Output, after: Output, period: float) -> float:
    """Return the seconds between two outputs beyond the time between their inputs."""
    expected = (after.sent - before.sent) / _NS if after.sent else period
    return (after.received - before.received) / _NS - expected


def outcome_of_handoff(ends: list[str], outputs: Sequence[Output], period: float) -> Outcome:
    """Return the outcome for a node that counts its outputs; `period` in seconds."""
    answered = [output.answered for output in outputs]
    sequence = [output.sequence for output in outputs]
    # Both must be gapless: no input without an answer, and no answer that the observer missed.
    missing = max(
        max(numbers) - min(numbers) + 1 - len(set(numbers)) for numbers in (answered, sequence)
    )
    repeated = max(len(numbers) - len(set(numbers)) for numbers in (answered, sequence))
    disorder = sum(later < earlier for earlier, later in itertools.pairwise(sequence))
    moved = changes(outputs)
    gaps = [gap(before, after, period) for before, after in moved]
    late = [(after.sent - before.sent) / _NS - period for before, after in moved if after.sent]
    return Outcome(ends, gaps, missing, repeated, disorder, driver_late=max(late, default=0.0))


def outcome_of_relaunch(ends: list[str], outputs: Sequence[Output], period: float) -> Outcome:
    """Return the outcome for a node with the same output in each cycle; `period` in seconds."""
    by_instance: dict[int, list[float]] = {}
    for output in outputs:
        by_instance.setdefault(output.instance, []).append(output.received / _NS)
    gaps, lost, repeated = [], 0, 0
    for before, after in itertools.pairwise(by_instance.values()):
        gaps.append(after[0] - before[-1] - period)
        lost += max(0, round((after[0] - before[-1]) / period) - 1)
        repeated += sum(time < before[-1] for time in after)
    return Outcome(ends, gaps, lost, repeated, 0)


def measure(
    strategy: str, driven: str, rate: float, runs: int, security: SecurityMode = "keys"
) -> Outcome:
    """Migrate a node to and fro, `runs` times, on a cluster of two hosts; `rate` in Hz.

    Raises:
        TimeoutError: a migration did not end, or the node's outputs ceased.
    """
    program = "tick" if strategy == "relaunch" else {"input": "echo", "timer": "count"}[driven]
    period = 1.0 / rate
    settings = ClusterConfig(
        migration=MigrationSettings(strategies={strategy: {}}, automatic=False), security=security
    )
    with contextlib.ExitStack() as stack:
        folder = stack.enter_context(tempfile.TemporaryDirectory(prefix="rosrm-handoff-"))
        cluster = stack.enter_context(
            LocalCluster(Path(folder), cluster=settings, hosts=three_hosts()[:2])
        )
        observer = Observer(cluster.domain or 0)
        stack.callback(observer.close)
        cluster.client.submit([process_of(strategy, program, rate)])
        cluster.wait_until("the node running", lambda view: view.processes[0].state == "running")
        if program == "echo":
            stack.enter_context(driver(cluster, rate))
        observer.wait_for(max(3, int(rate * _SETTLE)))
        ends, moves = [], []
        for run in range(runs):
            began = time.monotonic()
            ends.append(move(cluster))
            moves.append(time.monotonic() - began)
            observer.wait_for(max(3, int(rate * _SETTLE)))
            if (run + 1) % 10 == 0:
                say(f"{run + 1}/{runs} migrations at {rate:g} Hz")
        outputs = list(observer.outputs)
    outcome_of = outcome_of_relaunch if strategy == "relaunch" else outcome_of_handoff
    return replace(outcome_of(ends, outputs, period), moves=moves)


def main() -> None:
    """Measure and print one JSON object."""
    command_line = parser(__doc__)
    command_line.add_argument("--rate", type=float, default=10.0, help="outputs a second (Hz)")
    command_line.add_argument("--runs", type=int, default=100, help="number of migrations")
    command_line.add_argument(
        "--strategy",
        choices=["handoff", "relaunch"],
        default="handoff",
        help="migration strategy",
    )
    command_line.add_argument(
        "--driven",
        choices=["input", "timer"],
        default="input",
        help="source of the outputs with --strategy handoff",
    )
    chosen = command_line.parse_args()
    transports = isolated_transports()
    outcome = measure(chosen.strategy, chosen.driven, chosen.rate, chosen.runs)
    gaps = outcome.gaps
    print_report(
        "handoff",
        {
            "strategy": chosen.strategy, "driven": chosen.driven, "rate_hz": chosen.rate,
            "lost": outcome.lost, "repeated": outcome.repeated,
            "out_of_order": outcome.out_of_order,
            "gap_p50_ms": round(percentile(gaps, 0.5) * 1e3, 3) if gaps else None,
            "gap_p99_ms": round(percentile(gaps, 0.99) * 1e3, 3) if gaps else None,
            "gap_max_ms": round(max(gaps) * 1e3, 3) if gaps else None,
            "move_p50_s": round(percentile(outcome.moves, 0.5), 2),
            "move_max_s": round(max(outcome.moves), 2),
            "driver_late_max_ms": round(outcome.driver_late * 1e3, 3),
            "moved": outcome.ends.count("migrated"), "stayed": outcome.ends.count("stayed"),
            "transports": transports,
        },
        runs=chosen.runs,
    )  # fmt: skip


if __name__ == "__main__":
    sys.exit(run("handoff", main))
