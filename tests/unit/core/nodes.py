"""Simulated nodes that follow the handoff protocol, and the topics between them.

A `Node` belongs to one run of a program. It is active unless it was started as a shadow or has
fallen silent, whatever the master believes. Its quirks are its violations of the protocol.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from rosrm.core.master.commands import PublishStateConfig
from rosrm.core.master.events import HandoffReported
from rosrm.model.plan import HandoffPhase, ReportPhase
from rosrm.model.values import InstanceId

if TYPE_CHECKING:
    from tests.unit.core.machine import Machine

#: What a node may do wrong: it never answers; it says FAILED; as a destination it never receives a
#: state, is never ready, or does not answer to ABORT; as a source it never falls silent, or does
#: not answer to RESUME.
QUIRKS = ("deaf", "unfit", "no state", "never ready", "no abort", "never silent", "no resume")


@dataclass
class Node:
    """One run of a node.

    Attributes:
        shadow: True if the node starts silent, as the shadow of a handoff or as a restored node.
        quirks: shared with its machine, so that they may change while it runs.
        handoff: number of the destination of the handoff that it takes part in; 0: none.
        heard: reports received from the other node in this handoff.
        sent: reports sent in this handoff; a late subscriber receives all of them.
        configs, reports: messages on their way to this node.
    """

    instance: InstanceId
    shadow: bool
    quirks: set[str]
    active: bool = True
    handoff: int = 0
    heard: set[ReportPhase] = field(default_factory=set)
    sent: list[HandoffReported] = field(default_factory=list)
    configs: deque[PublishStateConfig] = field(default_factory=deque)
    reports: deque[HandoffReported] = field(default_factory=deque)
    switched: bool = False
    resumed: bool = False
    aborted: bool = False
    air: Air | None = None

    def __post_init__(self) -> None:
        self.active = not self.shadow

    def has_said(self, phase: ReportPhase) -> bool:
        return any(report.phase is phase for report in self.sent)

    @property
    def has_state(self) -> bool:
        """Return True for a destination that has restored a state of the source."""
        following = (ReportPhase.SHADOWING, ReportPhase.READY)
        return any(report.sequence and report.phase in following for report in self.sent)

    def say(self, phase: ReportPhase, message: str = "", sequence: int = 7) -> None:
        name, number = self.instance.process, self.instance.number
        report = HandoffReported(name, self.handoff, number, phase, sequence, message)
        self.sent.append(report)
        if self.air is not None:
            self.air.spread(self, report)

    def take_config(self) -> None:
        """Receive the next message of the master about a handoff that names this node."""
        config = self.configs.popleft()
        if "deaf" in self.quirks:
            return
        if config.destination != self.handoff:
            self.handoff, self.switched, self.resumed = config.destination, False, False
            self.sent.clear()
            self.heard.clear()
            if self.air is not None:
                self.air.open(self)
        number = self.instance.number
        (self._as_source if config.source == number else self._as_destination)(config.phase)

    def take_report(self) -> None:
        """Receive the next report of the other node in the channel."""
        report = self.reports.popleft()
        if "deaf" in self.quirks or report.destination != self.handoff:
            return
        self.heard.add(report.phase)
        if report.phase is ReportPhase.SHADOWING:
            self.say(ReportPhase.ATTACHED)
        elif report.phase is ReportPhase.ATTACHED:
            self._maybe_ready()
        elif report.phase is ReportPhase.SWITCHING:
            self._maybe_silent()
        elif report.phase is ReportPhase.SILENT:
            self._maybe_active()

    # --- source --------------------------------------------------------------------------

    def _as_source(self, phase: HandoffPhase) -> None:
        if phase is HandoffPhase.SHADOW and ReportPhase.SHADOWING in self.heard:
            self.say(ReportPhase.ATTACHED)
        elif phase is HandoffPhase.SWITCH:
            self.switched = True
            self._maybe_silent()
        elif phase is HandoffPhase.RESUME:
            self.resumed = True
            self.wake()
            if "no resume" not in self.quirks:
                self.say(ReportPhase.RESUMED)

    def _maybe_silent(self) -> None:
        if not self.switched or self.resumed or ReportPhase.SWITCHING not in self.heard:
            return
        if "unfit" in self.quirks:
            self.say(ReportPhase.FAILED, "the state is too large")
        elif "never silent" not in self.quirks:
            self.active = False
            self.say(ReportPhase.SILENT)
            self.say(ReportPhase.RELEASED)

    # --- destination ---------------------------------------------------------------------

    def _as_destination(self, phase: HandoffPhase) -> None:
        if phase is HandoffPhase.DONE:
            return
        if self.active:
            self.say(ReportPhase.ACTIVE)
        elif self.aborted:
            self.say(ReportPhase.ABORTED)
        elif phase is HandoffPhase.SHADOW:
            self._shadow(sequence=7 if self.has_state else 0)
            self._maybe_ready()
        elif phase is HandoffPhase.SWITCH:
            self.switched = True
            self.say(ReportPhase.SWITCHING)
            self._maybe_active()
        elif phase is HandoffPhase.TAKE_OVER and self.has_state:
            self._become_active()
        elif phase is HandoffPhase.ABORT and "no abort" not in self.quirks:
            self.aborted = True
            self.say(ReportPhase.ABORTED)

    def _shadow(self, sequence: int) -> None:
        self.say(ReportPhase.SHADOWING, "waits for input /scan", sequence)

    def _maybe_ready(self) -> None:
        if ReportPhase.ATTACHED not in self.heard or "no state" in self.quirks:
            return
        if "unfit" in self.quirks:
            self.say(ReportPhase.FAILED, "restore: KeyError: 'map'")
        elif "never ready" in self.quirks:
            if not self.has_state:
                self._shadow(sequence=7)
        else:
            self.say(ReportPhase.READY)

    def _maybe_active(self) -> None:
        silent = ReportPhase.SILENT in self.heard
        if self.switched and silent and not self.aborted and not self.active:
            self._become_active()

    def _become_active(self) -> None:
        self.wake()
        self.say(ReportPhase.ACTIVE)

    def wake(self) -> None:
        """Become active; the protocol guarantees that no other node is active at this moment."""
        self.active = True
        if self.air is not None and self.instance.number not in self.air.left:
            others = [
                str(one.instance)
                for one in self.air.others(self)
                if one.active and one.instance.number not in self.air.left
            ]
            assert not others, f"{self.instance} becomes active beside {others}"


class Air:
    """Topics of handoffs between the master and all nodes: latched, reliable, in order.

    Attributes:
        latched: messages that the present master has published.
        channels: channels to which the master is subscribed.
        to_master: reports on their way to the master, with the machine that sent them.
        left: instances that were given up with their lost hosts, and may be active there.
    """

    def __init__(self, machines: Callable[[], Iterable[Machine]]) -> None:
        self._machines = machines
        self.latched: list[PublishStateConfig] = []
        self.channels: set[tuple[str, int]] = set()
        self.to_master: list[tuple[Machine, HandoffReported]] = []
        self.left: set[int] = set()

    def nodes(self) -> Iterator[tuple[Machine, Node]]:
        """Yield every running node with its machine; a new node joins the topics first."""
        for machine in self._machines():
            for program in machine.programs.values():
                if program.node.air is None:
                    program.node.air = self
                    program.node.configs.extend(
                        config for config in self.latched if _names(config, program.node)
                    )
                yield machine, program.node

    def publish(self, config: PublishStateConfig) -> None:
        """Publish a message of the master; subscribe to the channel until the handoff is DONE."""
        channel = (config.process, config.destination)
        if config.phase is HandoffPhase.DONE:
            self.channels.discard(channel)
        elif channel not in self.channels:
            self.channels.add(channel)
            for machine, node in self.nodes():
                if (node.instance.process, node.handoff) == channel:
                    self.to_master += [(machine, report) for report in node.sent]
        for _, node in self.nodes():
            if _names(config, node):
                node.configs.append(config)
        self.latched.append(config)

    def spread(self, speaker: Node, report: HandoffReported) -> None:
        """Publish a report of a node in its channel."""
        for machine, node in self.nodes():
            if node is speaker:
                if (report.process, report.destination) in self.channels:
                    self.to_master.append((machine, report))
            elif _together(node, speaker):
                node.reports.append(report)

    def open(self, listener: Node) -> None:
        """Subscribe a node to its channel; it receives all earlier reports."""
        for _, node in self.nodes():
            if node is not listener and _together(node, listener):
                listener.reports.extend(node.sent)

    def others(self, node: Node) -> list[Node]:
        """Return the other nodes of a process that run and are reachable from this node."""
        name = node.instance.process
        return [
            one for machine, one in self.nodes()
            if one.instance.process == name and one is not node and machine.connected
        ]  # fmt: skip

    def master_is_gone(self) -> None:
        """Drop the master's topics with all messages that were not received yet."""
        self.latched.clear()
        self.channels.clear()
        self.to_master.clear()
        for _, node in self.nodes():
            node.configs.clear()

    def waiting(self) -> list[Callable[[], None]]:
        """Return a call for each message to a node that can arrive next."""
        arrivals: list[Callable[[], None]] = []
        for machine, node in self.nodes():
            if machine.connected and node.configs:
                arrivals.append(node.take_config)
            if machine.connected and node.reports and self._peers_connected(node):
                arrivals.append(node.take_report)
        return arrivals

    def _peers_connected(self, node: Node) -> bool:
        return all(machine.connected for machine, other in self.nodes() if _together(node, other))

    def next_reports(self) -> list[int]:
        """Return the reports that can reach the master next: the first of each node."""
        first: dict[int, int] = {}
        for at, (machine, report) in enumerate(self.to_master):
            if machine.connected:
                first.setdefault(report.instance, at)
        return list(first.values())


def _names(config: PublishStateConfig, node: Node) -> bool:
    named = (config.source, config.destination)
    return config.process == node.instance.process and node.instance.number in named


def _together(one: Node, other: Node) -> bool:
    return one.instance.process == other.instance.process and one.handoff == other.handoff != 0
