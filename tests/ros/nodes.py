"""Nodes that run as instances of rosrm, and a conductor in place of the master.

The nodes talk over real DDS. Only the master's decisions and the slaves are missing, so that a test
can send, or omit, each message at any moment.
"""

from __future__ import annotations

import base64
from array import array
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest
import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.serialization import serialize_message
from rclpy.signals import SignalHandlerOptions
from std_msgs.msg import Int64
from std_srvs.srv import Trigger

from rosrm.keys.handoffs import HandoffKeys, new_link
from rosrm.keys.names import handoff_name, instance_name
from rosrm.keys.sealing import Direction
from rosrm.node import Node
from rosrm.ros.qos import HANDOFF, STATE_CONFIG
from rosrm.ros.sealed_topic import SealedTopic
from rosrm.testing.local_cluster import claim_domain
from rosrm.version import PROTOCOL_VERSION
from rosrm_msgs.msg import HandoffReport, Sealed, StateConfig
from tests.waiting import PATIENCE, wait_until

TOPIC = "/rosrm/state_config"
STRANDED = "/rosrm/handoff/stranded"
#: Keys of a cluster whose instances all run on one host.
KEYS = HandoffKeys(
    lambda: b"secret of the cluster".ljust(32), lambda _process, _number: bytes(range(32))
)
#: Name of a destination.
ALIAS = "counter_1700000000"
CLUSTER = "rosrm"
EPOCH = 3
RELIABLE = QoSProfile(depth=1000, reliability=ReliabilityPolicy.RELIABLE)


class Counting:
    """Base of a node that counts by a timer, and sums up received numbers."""

    def __init__(self, name: str = "counter", period: float = 0.02, **named: Any) -> None:
        super().__init__(name, **named)
        self.count = 0
        self.total = 0
        self.output = self.create_publisher(Int64, "count", RELIABLE)
        self.sums = self.create_publisher(Int64, "sum", RELIABLE)
        self.create_subscription(Int64, "add", self.add, RELIABLE)
        self.timer = self.create_timer(period, self.tick)
        self.keep_state("~/state", Int64, self.save, self.restore)
        self.keep_state("~/total", Int64, lambda: Int64(data=self.total), self.restore_total)

    def tick(self) -> None:
        self.count += 1
        self.output.publish(Int64(data=self.count))

    def add(self, message: Int64) -> None:
        self.total += message.data
        self.sums.publish(Int64(data=self.total))

    def save(self) -> Int64:
        return Int64(data=self.count)

    def restore(self, message: Int64) -> None:
        self.count = message.data

    def restore_total(self, message: Int64) -> None:
        self.total = message.data


class Serving(Counting):
    """A counter that answers requests with its name, and counts them."""

    def __init__(self, group: Any = None, **named: Any) -> None:
        super().__init__(**named)
        self.served = 0
        self.create_service(Trigger, "~/poke", self.poke, callback_group=group)

    def poke(self, _request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self.served += 1
        response.message = self.get_name()
        return response


class Counter(Counting, Node):
    """`Counting` as a node of `rosrm.node`."""


class Server(Serving, Node):
    """`Serving` as a node of `rosrm.node`."""


def hold(node: Any) -> None:
    """Keep a shadow from its activation."""
    if isinstance(node, Node):
        node._rosrm._destination._activate = lambda: None
    else:
        node.hold()


def withhold(node: Any) -> Callable[[], None]:
    """Withhold the inputs of a shadow, until the returned function delivers them."""
    is_python = isinstance(node, Node)
    owner, name = (node._rosrm.entities, "_keep") if is_python else (node._core, "arrived")
    deliver, held = getattr(owner, name), []
    setattr(owner, name, lambda *what: held.append(what))

    def release() -> None:
        setattr(owner, name, deliver)
        for what in held:
            deliver(*what)

    return release


def buffered(node: Any) -> int:
    """Return the number of messages that a node has buffered."""
    return len(node._rosrm.entities.buffer) if isinstance(node, Node) else node.buffered


def held_requests(node: Any) -> int:
    """Return the number of requests that a silent node holds."""
    if not isinstance(node, Node):
        return node.held_requests
    openings = node._rosrm.entities._openings
    return sum(len(one._held) for one in openings if hasattr(one, "srv_name"))


class Stage:
    """A ROS context with an executor, on which nodes run as instances of processes.

    Args:
        beside: another stage, whose domain and spinning this one shares, as a separate
            DDS participant.
        domain: domain of an existing cluster.
        keys: of the cluster; None: it has no security.
    """

    def __init__(
        self, beside: Stage | None = None, domain: int | None = None,
        keys: HandoffKeys | None = None,
    ) -> None:  # fmt: skip
        self.keys = beside.keys if beside is not None else keys
        self._claim = None
        self._beside: list[Stage] = []
        if beside is not None:
            self.domain = beside.domain
            beside._beside.append(self)
        elif domain is not None:
            self.domain = domain
        else:
            self.domain, self._claim = claim_domain()
        self.context = rclpy.Context()
        rclpy.init(
            context=self.context,
            domain_id=self.domain,
            signal_handler_options=SignalHandlerOptions.NO,
        )
        self.executor = SingleThreadedExecutor(context=self.context)
        self.nodes: list[Any] = []
        self.plain = self.add(rclpy.node.Node("observer", context=self.context))

    def add(self, node: Any) -> Any:
        self.executor.add_node(node)
        self.nodes.append(node)
        return node

    def instance(
        self, make: Callable[..., Any], number: int, *, name: str = "counter", alias: str = "",
        shadow: bool = False, keep: Any = "", **named: Any,
    ) -> Any:  # fmt: skip
        """Create a node in the environment that a slave would give the instance."""
        with pytest.MonkeyPatch.context() as patch:
            for variable, value in self.environment(name, number, shadow=shadow, keep=keep).items():
                patch.setenv(variable, value)
            if alias:
                named["cli_args"] = ["--ros-args", "-r", f"__node:={alias}"]
            return self.add(make(context=self.context, **named))

    def environment(
        self, name: str, number: int, *, shadow: bool, keep: Any = ""
    ) -> dict[str, str]:
        """Return the variables that a slave would give an instance."""
        key = b"" if self.keys is None else self.keys.of_instance(name, number)
        return {
            "ROSRM_INSTANCE_KEY": base64.b64encode(key).decode(),
            "ROSRM_INSTANCE": f"{name}#{number}", "ROSRM_PROCESS": name, "ROSRM_NODE": f"/{name}",
            "ROSRM_STATE_CONFIG": TOPIC, "ROSRM_MASTER": CLUSTER, "ROSRM_EPOCH": str(EPOCH),
            "ROSRM_SHADOW": "1" if shadow else "", "ROSRM_KEEP": str(keep),
        }  # fmt: skip

    def spin_until(
        self,
        condition: Callable[[], bool],
        what: str,
        timeout: float = PATIENCE,
        seen: Callable[[], object] = lambda: "",
    ) -> None:
        """Spin the nodes until a condition holds; `seen` describes the actual state."""
        wait_until(condition, what, timeout, seen=seen, pause=lambda _: self.spin(0.05))

    def spin(self, seconds: float) -> None:
        """Execute ready callbacks for at most `seconds`."""
        self.executor.spin_once(timeout_sec=seconds)
        for stage in self._beside:
            stage.executor.spin_once(timeout_sec=0.0)

    def listen(self, message_type: Any, topic: str, qos: Any = RELIABLE) -> list[Any]:
        """Return a list that collects all messages on a topic from now on."""
        heard: list[Any] = []
        self.plain.create_subscription(message_type, topic, heard.append, qos)
        return heard

    def listen_to(self, topic: SealedTopic, qos: Any) -> list[Any]:
        """Return a list that collects all messages of a sealed topic that open."""
        heard: list[Any] = []

        def take(data: bytes) -> None:
            message = topic.read(data)
            if message is not None:
                heard.append(message)

        topic.subscription(self.plain, qos, take)
        return heard

    def remove(self, node: Any) -> None:
        self.nodes.remove(node)
        self.executor.remove_node(node)
        node.destroy_node()

    def close(self) -> None:
        self.executor.shutdown()
        for node in self.nodes:
            node.destroy_node()
        self.context.try_shutdown()
        for stage in self._beside:
            stage.close()
        if self._claim is not None:
            self._claim.close()


class Conductor:
    """A stand-in for the master in one handoff, which publishes phases and records reports."""

    def __init__(
        self, stage: Stage, *, source: int, destination: int, name: str = "counter"
    ) -> None:
        self._stage = stage
        self._configs: dict[tuple[str, int], SealedTopic] = {}
        self._reports: Any = None
        key = None if stage.keys is None else stage.keys.of_handoff(name, destination)
        self.config = StateConfig(
            protocol_version=PROTOCOL_VERSION, cluster=CLUSTER, epoch=EPOCH, process=name,
            source=source, destination=destination, source_node=f"/{name}",
            destination_node=f"/{name}_{destination}",
            channel=f"/rosrm/handoff/{name}_{destination}", key=array("B", key or b""),
        )  # fmt: skip
        self._publisher = stage.plain.create_publisher(Sealed, TOPIC, STATE_CONFIG)
        self.reports: list[HandoffReport] = stage.listen_to(
            self.topic(HandoffReport, self.config.channel), HANDOFF
        )

    def topic(self, message_type: Any, name: str) -> SealedTopic:
        """Return a topic of the handoff for one more party that has its key."""
        link = new_link(bytes(self.config.key) or None, Direction.TO_PEER, Direction.TO_PEER)
        principal = handoff_name(self.config.process, self.config.destination)
        return SealedTopic(link, principal, message_type, name)

    def say(self, phase: int, **other: Any) -> None:
        """Publish a phase to both nodes; `other` overrides fields of the correct message."""
        right = {
            field: getattr(self.config, field) for field in self.config.get_fields_and_field_types()
        }
        runs = [one.run for one in self.reports if one.instance == self.config.source]
        right["source_run"] = runs[-1] if runs else 0
        config = StateConfig(**{**right, "phase": phase, **other})
        plain = serialize_message(config)
        for number in (config.source, config.destination):
            self._publisher.publish(self._config_of(config.process, number).seal(plain))

    def _config_of(self, process: str, number: int) -> SealedTopic:
        known = self._configs.get((process, number))
        if known is None:
            known = _of_instance(self._stage.keys, process, number, StateConfig, TOPIC)
            self._configs[process, number] = known
        return known

    def questions(self) -> list[HandoffReport]:
        """Return a list that collects the questions of the silent source."""
        config = self.config
        topic = _of_instance(
            self._stage.keys, config.process, config.source, HandoffReport, STRANDED
        )
        return self._stage.listen_to(topic, HANDOFF)

    def report_as(self, instance: int, *phases: int, destination: int | None = None) -> None:
        """Publish reports with the handoff's key, but of any instance."""
        if self._reports is None:
            topic = self.topic(HandoffReport, self.config.channel)
            self._reports = topic.publisher(self._stage.plain, HANDOFF)
        for phase in phases:
            self._reports.publish(
                HandoffReport(
                    protocol_version=PROTOCOL_VERSION, instance=instance, phase=phase,
                    destination=self.config.destination if destination is None else destination,
                )
            )  # fmt: skip

    def of(self, number: int) -> list[int]:
        """Return the phases that an instance reported."""
        return [report.phase for report in self.reports if report.instance == number]

    def wait(self, number: int, phase: int, timeout: float = PATIENCE) -> HandoffReport:
        """Wait until an instance reports a phase."""
        self._stage.spin_until(
            lambda: phase in self.of(number),
            f"report {phase} of {number}",
            timeout,
            lambda: [(report.instance, report.phase, report.message) for report in self.reports],
        )
        return next(
            report for report in reversed(self.reports)
            if report.instance == number and report.phase == phase
        )  # fmt: skip

    def prepare(self) -> None:
        """Conduct a handoff until the destination is ready."""
        self.say(StateConfig.SHADOW)
        self.wait(self.config.destination, HandoffReport.READY)

    def hand_over(self) -> None:
        """Conduct a handoff without faults."""
        self.prepare()
        self.say(StateConfig.SWITCH)
        self.wait(self.config.destination, HandoffReport.ACTIVE)
        self.wait(self.config.source, HandoffReport.RELEASED)

    def silence(self, destination: Any) -> None:
        """Silence the source, while its destination, a node, stays a shadow."""
        hold(destination)
        self.prepare()
        self.say(StateConfig.SWITCH)
        self.wait(self.config.source, HandoffReport.RELEASED)

    def silence_alone(self) -> None:
        """Silence the source with messages of the master and of a destination that does not run."""
        source, destination = self.config.source, self.config.destination
        self.say(StateConfig.SHADOW)
        self.report_as(destination, HandoffReport.SHADOWING)
        self.wait(source, HandoffReport.ATTACHED)
        self.say(StateConfig.SWITCH)
        self.report_as(destination, HandoffReport.SWITCHING)
        self.wait(source, HandoffReport.RELEASED)

    def resume(self) -> None:
        """Undo a handoff: the source resumes."""
        self.say(StateConfig.ABORT)
        self.wait(self.config.destination, HandoffReport.ABORTED)
        self.say(StateConfig.RESUME)
        self.wait(self.config.source, HandoffReport.RESUMED)


def _of_instance(
    keys: HandoffKeys | None, process: str, number: int, message_type: Any, topic: str
) -> SealedTopic:
    """Return a topic between the master and an instance, at the master's side."""
    key = None if keys is None else keys.of_instance(process, number)
    link = new_link(key, Direction.FROM_MASTER, Direction.TO_MASTER)
    return SealedTopic(link, instance_name(process, number), message_type, topic)


def pair_of(stage: Stage, make: Callable[..., Any], **named: Any) -> SimpleNamespace:
    """Return a source, its shadow as destination, and the conductor of their handoff."""
    first = stage.instance(make, 1, **named)
    second = stage.instance(make, 2, alias=ALIAS, shadow=True, **named)
    return SimpleNamespace(
        first=first, second=second, conductor=Conductor(stage, source=1, destination=2)
    )
