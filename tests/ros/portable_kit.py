"""Portable counters in a cluster: who hears them, who moves them, what a move must not leave."""

from __future__ import annotations

import contextlib
import threading
import time
from itertools import pairwise
from pathlib import Path

import psutil
import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import QoSProfile
from rclpy.signals import SignalHandlerOptions
from std_msgs.msg import Int64MultiArray

from rosrm.config.settings import MigrationSettings, ProcessDefaults
from rosrm.errors import Refused
from rosrm.model.values import MigrationPolicy, ProcessSpec, RestartPolicy
from rosrm_criu.engine import process_tree, restore_result
from tests.ros.clusters import MIB, PATIENCE, QUICK, Cluster, Make, host, wait_until

NAME = "portable_counter"
#: Both slaves are this test's own, and where CRIU works they mostly run as root.
AS_ROOT = {"criu": {"as_root": True}}


def two_hosts(make: Make, **settings) -> Cluster:
    """Return a cluster of `left` and `right`, without automatic migrations."""
    return make(
        host("left", strategies=AS_ROOT), host("right", strategies=AS_ROOT),
        migration=MigrationSettings(strategies={"relaunch": {}, "criu": {}}, automatic=False),
        defaults=ProcessDefaults(needs={"memory": MIB}), **settings,
    )  # fmt: skip


class Listener:
    """Receiver of the counts of portable counters, in a thread of its own."""

    def __init__(self, domain: int) -> None:
        self._context = rclpy.Context()
        rclpy.init(
            context=self._context, domain_id=domain, signal_handler_options=SignalHandlerOptions.NO
        )
        self._node = rclpy.create_node("listener", context=self._context)
        self._node.create_subscription(Int64MultiArray, "count", self._take, QoSProfile(depth=1000))
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)
        self.counts: list[int] = []
        self.checksums: set[int] = set()
        self._thread = threading.Thread(target=self._executor.spin, daemon=True)
        self._thread.start()

    def _take(self, message: Int64MultiArray) -> None:
        count, passes, checksum = message.data
        self.counts.append(count)
        if passes:
            self.checksums.add(checksum)

    def receive(self, more: int, patience: float = PATIENCE) -> None:
        """Wait for so many more counts, at most `patience` seconds."""
        wanted, deadline = len(self.counts) + more, time.monotonic() + patience
        while len(self.counts) < wanted:
            assert time.monotonic() < deadline, f"{len(self.counts)} counts of {wanted}"
            time.sleep(0.01)

    def steps(self) -> list[int]:
        """From each count to the next one."""
        return [after - before for before, after in pairwise(list(self.counts))]

    def forget(self) -> None:
        """Another counter begins."""
        self.counts.clear()
        self.checksums.clear()

    def close(self) -> None:
        self._executor.shutdown()
        self._thread.join(5.0)
        self._node.destroy_node()
        self._context.try_shutdown()


def counter(*arguments: str, **fields) -> ProcessSpec:
    """Return the example, which counts 50 times a second and has a heap of 1 MB."""
    options = fields.pop("options", {})
    program = fields.pop("command", ())
    if not program:
        fields["module"] = "rosrm_examples.portable_counter"
        arguments = arguments or ("--period", "0.02")
    fields.setdefault("restart", RestartPolicy("on-failure", delay=0.1))
    return ProcessSpec(
        NAME, command=program, arguments=arguments, ros=True,
        migration=MigrationPolicy("criu", options=options), stop=QUICK, **fields,
    )  # fmt: skip


def ask(cluster: Cluster, to: str | None = None, name: str = NAME) -> str:
    """Request a migration once the hosts' capabilities are known; return the refusal, or ""."""
    deadline = time.monotonic() + PATIENCE
    while "not known yet" in (refusal := _asked(cluster, to, name)):
        assert time.monotonic() < deadline, refusal
        cluster.client.spin(0.1)
    return refusal


def _asked(cluster: Cluster, to: str | None, name: str) -> str:
    try:
        cluster.client.migrate(name, to)
    except Refused as refusal:
        return str(refusal)
    return ""


def found_below(cluster: Cluster, pattern: str) -> list[Path]:
    """Return the image files of all hosts; a folder may vanish during the search."""
    while True:
        with contextlib.suppress(FileNotFoundError):
            return sorted(cluster.directory.glob(f"hosts/*/images/{pattern}"))


#: Seconds after which an image of an interrupted restore is removed, also if the slave was killed,
#: and a margin.
UNUSED = 140.0


def nothing_left(cluster: Cluster, *, but: str = "?") -> None:
    """Check that there is no image, no stopped process and no sender.

    Args:
        but: host whose images do not count.
    """

    def images() -> list[Path]:
        found = found_below(cluster, "**/*")
        # The result of a restore stays as long as its instance.
        counted = [path for path in found if but not in path.parts]
        return [path for path in counted if path.is_file() and path.name != restore_result.FILE]

    wait_until(lambda: not images(), f"no image left: {images()}", UNUSED)
    slaves = {part.process.pid for part in cluster.slaves.values()}
    serving = [
        one.pid
        for one in psutil.process_iter(["ppid", "cmdline"])
        if one.info["ppid"] in slaves and "send" in (one.info["cmdline"] or ())
    ]
    assert not serving
    for pid in pids(cluster):
        assert not process_tree.is_stopped(process_tree.root_of(pid))


def pids(cluster: Cluster) -> list[int]:
    """Return the pids of the leaders of the counter's instances."""
    mark = f"{NAME}#"
    found = []
    for one in psutil.process_iter(["environ"]):
        environment = one.info["environ"] or {}
        ours = str(cluster.directory) in environment.get("ROSRM_SUPERVISOR", "")
        if ours and environment.get("ROSRM_INSTANCE", "").startswith(mark):
            found.append(one.pid)
    return found
