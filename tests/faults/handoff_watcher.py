"""An external watcher of a handoff, which injects faults at chosen protocol messages."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable, Sequence
from itertools import groupby, pairwise
from typing import Any, NamedTuple

import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.signals import SignalHandlerOptions
from std_msgs.msg import Int64, Int64MultiArray

from benchmarks.handoff_nodes import INPUT, OUTPUT, QOS
from rosrm.keys.finding import host_security, master_security
from rosrm.keys.handoffs import new_link
from rosrm.keys.names import handoff_name, named_instance
from rosrm.keys.sealing import Direction
from rosrm.ros import qos
from rosrm.ros.qos import HANDOFF, STATE_CONFIG
from rosrm.ros.sealed_codec import decode
from rosrm.ros.sealed_topic import SealedTopic
from rosrm.supervisor.procfs import read_environment
from rosrm_msgs.msg import HandoffReport, ProcessStatus, ProcessStatusBatch, Sealed, StateConfig
from tests.ros.clusters import Cluster, pids_of, zombie

STATE_CONFIG_TOPIC = "/rosrm/state_config"
STATUS_TOPIC = "/rosrm/process_status"
#: Handoff phases by the names that the tests use.
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

#: Events after which a missing one counts as received. The master stops a released source, which
#: may end before the watcher has its last report.
FOLLOWING = {"RELEASED": "source stopping"}

#: Action of a fault injector.
Fault = Callable[[], None]


class Output(NamedTuple):
    """The instance that published an output, its number, and the answered input; 0: none."""

    instance: int
    sequence: int
    answers: int


class Watcher:
    """A thread that receives outputs, `state_config`, handoff channels and process status.

    A recorded event is "says SHADOW" for a message of the master, "READY" for a report of the
    source or the destination, "source stopping" for a status from a slave. "source policy" means
    that a slave has applied another restart policy: it then sends the status again, otherwise
    unchanged.

    Attributes:
        outputs, heard: outputs and events since `inject_at`.
        injected: set after the last fault.
        destination_pid: newest pid from the destination's slave; 0: none.

    Args:
        domain: ROS domain.
        hosts: of the cluster, whose secret this user has.
        inputs: inputs per second to publish, numbered from 1; 0: none.
    """

    def __init__(self, domain: int, hosts: Sequence[str], inputs: float = 0.0) -> None:
        self._hosts = [host_security("keys", host) for host in hosts]
        self._configs: dict[str, list[SealedTopic]] = {}
        master = master_security("keys")
        slaves = [master.peer(f"host:{host}", 0) for host in hosts]
        self._statuses = [
            SealedTopic(slave.link, slave.name, ProcessStatusBatch, STATUS_TOPIC)
            for slave in slaves
        ]
        self.outputs: list[Output] = []
        self.heard: list[str] = []
        self.injected = threading.Event()
        self.destination_pid = 0
        self._source = 0
        self._faults: list[tuple[str, Fault]] = []
        self._states: dict[int, str] = {}
        self._channels: set[str] = set()
        self._sent = 0
        self._context = rclpy.Context()
        rclpy.init(
            context=self._context, domain_id=domain, signal_handler_options=SignalHandlerOptions.NO
        )
        self._node = node = rclpy.node.Node("watcher", context=self._context)
        node.create_subscription(Int64MultiArray, OUTPUT, self._output, QOS)
        node.create_subscription(Sealed, STATE_CONFIG_TOPIC, self._said, STATE_CONFIG, raw=True)
        node.create_subscription(Sealed, STATUS_TOPIC, self._told, qos.STATUSES, raw=True)
        if inputs:
            self._inputs = node.create_publisher(Int64, INPUT, QOS)
            node.create_timer(1.0 / inputs, self._drive)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(node)
        self._thread = threading.Thread(target=self._executor.spin, daemon=True)
        self._thread.start()

    def inject_at(self, source: int, *faults: tuple[str, Fault]) -> None:
        """Inject faults at these events, in order, in the next handoff of instance `source`."""
        self.injected.clear()
        self.outputs.clear()
        self.heard.clear()
        self.destination_pid = 0
        self._source, self._faults = source, list(faults)

    def slaves(self) -> set[bytes]:
        """Return the publishers of process status that are discovered, one for each slave's run."""
        found = self._node.get_publishers_info_by_topic(STATUS_TOPIC)
        return {bytes(one.endpoint_gid) for one in found}

    def _drive(self) -> None:
        self._sent += 1
        self._inputs.publish(Int64(data=self._sent))

    def _output(self, message: Int64MultiArray) -> None:
        self.outputs.append(Output(*message.data))

    def _said(self, data: bytes) -> None:
        name = decode(data).principal
        process, number = named_instance(name)
        if name not in self._configs:  # any of the hosts may run the instance
            keys = [host.instance_key(process, number) for host in self._hosts]
            self._configs[name] = [
                SealedTopic(
                    new_link(key, Direction.TO_MASTER, Direction.FROM_MASTER), name, StateConfig,
                    STATE_CONFIG_TOPIC,
                )
                for key in keys
            ]  # fmt: skip
        config = _read(self._configs[name], data)
        if config is None:
            return
        if config.channel not in self._channels:
            self._channels.add(config.channel)
            self._listen_to(config)
        if config.source == self._source == number:  # not the copy for the destination
            self._hear(f"says {SAID[config.phase]}")

    def _listen_to(self, config: StateConfig) -> None:
        link = new_link(bytes(config.key) or None, Direction.TO_PEER, Direction.TO_PEER)
        name = handoff_name(config.process, config.destination)
        reports = SealedTopic(link, name, HandoffReport, config.channel)
        reports.subscription(self._node, HANDOFF, lambda data: self._reported(reports.read(data)))

    def _reported(self, report: HandoffReport | None) -> None:
        if report is not None and report.instance >= self._source:
            self._hear(REPORTED[report.phase])

    def _told(self, data: bytes) -> None:
        batch = _read(self._statuses, data)
        for status in batch.statuses if batch else ():
            self._is(status, repeats=batch.complete)

    def _is(self, status: ProcessStatus, *, repeats: bool) -> None:
        number = status.instance.number
        before, self._states[number] = self._states.get(number), status.state
        if number < self._source or (repeats and before == status.state):
            return
        role = "source" if number == self._source else "destination"
        if role == "destination":
            self.destination_pid = status.pid
        repeats = before == status.state != "starting"  # a start may be reported twice
        self._hear(f"{role} {'policy' if repeats else status.state}")

    def _hear(self, word: str) -> None:
        self.heard.append(word)
        awaited = self._faults[0][0] if self._faults else ""
        if word in (awaited, FOLLOWING.get(awaited)):
            _, fault = self._faults.pop(0)
            fault()
            if not self._faults:
                self.injected.set()

    def close(self) -> None:
        self._executor.shutdown()
        self._thread.join(5.0)
        self._node.destroy_node()
        self._context.try_shutdown()


def _read(topics: list[SealedTopic], data: bytes) -> Any:
    """Return the message that one of the topics opens; None: it has been read already.

    A busy machine may lose and find a participant, whose newest message then comes once more.
    """
    return next((found for topic in topics if (found := topic.read(data)) is not None), None)


def blocks(outputs: list[Output]) -> list[list[Output]]:
    """Group the outputs, in order of arrival, by the instance that published them."""
    return [list(group) for _, group in groupby(outputs, lambda one: one.instance)]


def is_gapless(outputs: list[Output]) -> bool:
    """Return True if each number and each answered input occurs once and in order."""
    counts = ([one.sequence for one in outputs], answered_by(outputs))
    pairs = (pair for count in counts for pair in pairwise(count))
    return all(after == before + 1 for before, after in pairs)


def answered_by(outputs: list[Output]) -> list[int]:
    """Return the inputs that were answered, in order."""
    return [one.answers for one in outputs if one.answers]


def instances(cluster: Cluster, process: str) -> dict[int, int]:
    """Return the pids of a process's running instances in a cluster, by instance number."""
    mark, found = f"ROSRM_INSTANCE={process}#".encode(), {}
    for pid in pids_of(cluster.directory):
        with contextlib.suppress(OSError):
            variables = read_environment(pid)
            number = next((v.removeprefix(mark) for v in variables if v.startswith(mark)), b"")
            if number and not zombie(pid):
                found[int(number)] = pid
    return found
