"""Hears a whole handoff from outside, and strikes at one word of it."""

from __future__ import annotations

import contextlib
import itertools
import os
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.signals import SignalHandlerOptions
from std_msgs.msg import Int64MultiArray

from benchmarks.handoff_nodes import OUTPUT, QOS
from rosrm.node.channel import CHANNEL, STATE_CONFIG
from rosrm_msgs.msg import HandoffReport, StateConfig
from tests.ros.clusters import Cluster, pids_of, zombie

#: The words of a handoff by the names that the tests use.
SAID = {
    getattr(StateConfig, name): name
    for name in ("SHADOW", "SWITCH", "TAKE_OVER", "ABORT", "RESUME", "DONE")
}
REPORTED = {
    getattr(HandoffReport, name): name
    for name in (
        "ATTACHED", "SILENT", "RELEASED", "RESUMED", "SHADOWING", "READY", "SWITCHING", "ACTIVE",
        "ABORTED", "FAILED",
    )
}  # fmt: skip


class Output(NamedTuple):
    """Which instance said which number."""

    instance: int
    sequence: int


class Watcher:
    """Hears outputs, `state_config` and the channels, in a participant and a thread of its own."""

    def __init__(self, domain: int) -> None:
        self.outputs: list[Output] = []
        self.heard: list[str] = []
        self._strike: tuple[str, Callable[[], None]] | None = None
        self.struck = threading.Event()
        self._channels: set[str] = set()
        self._context = rclpy.Context()
        rclpy.init(
            context=self._context, domain_id=domain, signal_handler_options=SignalHandlerOptions.NO
        )
        self._node = rclpy.node.Node("watcher", context=self._context)
        self._node.create_subscription(Int64MultiArray, OUTPUT, self._output, QOS)
        self._node.create_subscription(StateConfig, "/rosrm/state_config", self._said, STATE_CONFIG)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)
        self._thread = threading.Thread(target=self._executor.spin, daemon=True)
        self._thread.start()

    def strike_at(self, word: str, blow: Callable[[], None]) -> None:
        """Do something the moment a word of a later handoff is heard."""
        self.struck.clear()
        self.heard.clear()
        self._strike = (word, blow)

    def _output(self, message: Int64MultiArray) -> None:
        self.outputs.append(Output(*message.data[:2]))

    def _said(self, config: StateConfig) -> None:
        if config.channel not in self._channels:
            self._channels.add(config.channel)
            self._node.create_subscription(HandoffReport, config.channel, self._reported, CHANNEL)
        self._hear(f"says {SAID[config.phase]}")

    def _reported(self, report: HandoffReport) -> None:
        self._hear(REPORTED[report.phase])

    def _hear(self, word: str) -> None:
        self.heard.append(word)
        if self._strike is not None and self._strike[0] == word:
            _, blow = self._strike
            self._strike = None
            blow()
            self.struck.set()

    def close(self) -> None:
        self._executor.shutdown()
        self._thread.join(5.0)
        self._node.destroy_node()
        self._context.try_shutdown()


def blocks(outputs: list[Output]) -> list[list[Output]]:
    """The outputs, in the order in which they came, by who spoke."""
    return [list(group) for _, group in itertools.groupby(outputs, lambda one: one.instance)]


def instances(cluster: Cluster, process: str, *, shadows: bool = False) -> dict[int, int]:
    """The pids of the instances of a process that run in a cluster, by number.

    Args:
        shadows: only those that were started as one, and not again since.
    """
    mark, found = f"ROSRM_INSTANCE={process}#", {}
    for pid in pids_of(cluster.directory):
        with contextlib.suppress(OSError):
            variables = Path(f"/proc/{pid}/environ").read_text().split("\0")
            number = next((v.removeprefix(mark) for v in variables if v.startswith(mark)), "")
            if number and not zombie(pid) and not (shadows and "ROSRM_SHADOW=1" not in variables):
                found[int(number)] = pid
    return found


def kill(find: Callable[[], int], number: int) -> Callable[[], None]:
    """A blow: end a process that is looked for when it falls."""

    def blow(*_: Any) -> None:
        pid = find()
        assert pid > 1, "the victim is not there"
        os.kill(pid, number)

    return blow
